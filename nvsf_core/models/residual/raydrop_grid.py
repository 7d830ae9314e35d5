"""What returns, in the recording sensor's own grid of lasers and firings, as the other scans lead to expect.

The ray head of a field has seen the training scans: there its hits look better than elsewhere, and what
learned to correct them would trust them too much. So the network here is not told the ray head's hits. It
starts from the vote, and from what other turns recorded where a ray is expected to end: these are of other
scans at training and at rendering alike. Where the ray ends, and how bright, is the field's answer, which
knows a training scan's own returns. The two answers err differently, and are blended (`HitBlend`).
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from nvsf_core.errors import ShapeError
from nvsf_core.evidence.raydrop.prior import DropPrior
from nvsf_core.fields.cell_network import CellNetwork
from nvsf_core.kernels.scan_lookup import (
    BESIDE,
    EMPTY,
    SAME,
    SHINE,
    THROUGH,
    Lasers,
    SweepGrid,
    look_up_scans,
)
from nvsf_core.numerics import probability_logit
from nvsf_core.recipe import HitsSpec
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable
from nvsf_core.simulation.raydrop import HitBlend
from nvsf_core.simulation.scan import SweepRays

FEATURES = 14
"""Channels that describe a cell."""
_BESIDE = 2
"""Of the scans that are asked, those nearest in time: told by themselves, too."""
_VOTE_LIMIT, _HIT_LIMIT = 0.02, 0.003
_MOMENTS = 256
"""Parts of a turn at which the sensor's pose is looked up."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSweeps:
    """The training scans in the grid of lasers and firings, and how their sensor moved."""

    prior: DropPrior
    lasers: np.ndarray
    """(l,) int64: those that ever returned, from the top."""
    range_m: np.ndarray
    """(n, lasers, f) float32 along the laser's ray, without its bias; 0 = no return."""
    intensity: np.ndarray
    """(n, lasers, f) float32 as recorded."""
    trajectory: Trajectory
    table: LaserTable
    period_s: float
    turn_up_rad: float
    """How far recorded directions are turned up on their way into the world."""

    def ask(self, points_m: np.ndarray, scans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sums (r, 5) float32 of what scans say of points (r, 3) float32, of the first two and of all."""
        table, rows = self.table, self.lasers
        shift_rad = (table.phase_steps - table.firing_shift_steps)[rows] * table.step_rad
        lasers = Lasers(
            rows, table.elevation_rad[rows], table.vertical_offset_m[rows], table.horizontal_offset_m[rows],
            shift_rad, self.turn_up_rad,
        )  # fmt: skip
        moments = (np.arange(_MOMENTS) + 0.5) / _MOMENTS - 0.5
        found = np.zeros((len(points_m), 5), np.float32)
        beside = found
        for number, scan in enumerate(scans.tolist()):
            if number == _BESIDE:
                beside = found.copy()
            rotation, position = self.trajectory.at(self.prior.time_s[scan] + moments * self.period_s)
            fraction = self.prior.fraction[scan][: self.prior.firings_of(scan)]
            turn = SweepGrid(rotation, position, fraction, self.range_m[scan], self.intensity[scan])
            look_up_scans(points_m, lasers, turn, found)
        return beside, found


def hits_network(spec: HitsSpec, generator: torch.Generator) -> CellNetwork:
    """Untrained; weights are drawn from `generator`."""
    return CellNetwork(FEATURES, 1, generator, channels=spec.channels, layers=spec.layers)


@dataclass(frozen=True, slots=True)
class SweepRaydrop:
    """Corrects the hits of the recording sensor's own turns."""

    network: CellNetwork
    """Trained."""
    scan_grids: RecordedSweeps
    blend: HitBlend

    def __call__(self, rays: SweepRays, rendered: RenderedRays, near: np.ndarray) -> RenderedRays:
        """The same answers with other hits; `near` (k,) are the scans that vote, nearest in time first."""
        both = hit_logits(self.network, self.scan_grids, rays, rendered, near)
        hit = expit(self.blend.logit(*both)).astype(np.float32)
        return replace(rendered, hit=np.where(np.isfinite(rendered.range_m), hit, rendered.hit))


@torch.no_grad()
def hit_logits(
    network: CellNetwork,
    scan_grids: RecordedSweeps,
    rays: SweepRays,
    rendered: RenderedRays,
    near: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """What network and ray head say of each ray of a turn: logits (r,) float32 of a return."""
    cells = sweep_cells(scan_grids, rays, rendered, near)
    learned = cells.prior_logit + network(cells.features[None])[0, 0]
    back = torch.empty_like(learned).scatter_(1, cells.column, learned).reshape(-1)
    return back.numpy(), probability_logit(torch.from_numpy(rendered.hit), _HIT_LIMIT).numpy()


@dataclass(frozen=True, slots=True)
class SweepCells:
    """A turn of the recording sensor, as the network is told of it; one azimuth is one column."""

    column: Tensor
    """(l, f) int64: which firing of its laser a cell is."""
    features: Tensor
    """(FEATURES, l, f) float32, each about -1..1."""
    prior_logit: Tensor
    """(l, f) float32: of the share of scans that returned."""
    is_met: Tensor
    """(l, f) bool: whether a return can be expected at all."""


def sweep_cells(
    scan_grids: RecordedSweeps, rays: SweepRays, rendered: RenderedRays, near: np.ndarray
) -> SweepCells:
    """What is told of a turn's cells; arguments as of `SweepRaydrop`. The ray head's hits are not asked.

    Raises:
        ShapeError: The answers do not tell the votes.
    """
    if rendered.hit_prior is None:
        raise ShapeError(
            "sweep_cells: expected rays with hit priors, found none; a field's renderer gives them"
        )
    lasers, firings = rays.shape
    is_met = np.isfinite(rendered.range_m)
    range_m = np.where(is_met, rendered.range_m, 0.0).astype(np.float32)
    points_m = rays.origin_m + rays.direction * rendered.range_m[:, None]
    beside, asked = scan_grids.ask(points_m.astype(np.float32), near)
    share = asked / np.float32(len(near))
    share_beside = beside / np.float32(min(len(near), _BESIDE))
    shine = asked[:, SHINE] / np.maximum(asked[:, SAME], 1.0)
    level = np.repeat(np.linspace(-1.0, 1.0, lasers, dtype=np.float32), firings)
    channels = (
        rendered.hit_prior - 0.5,
        scan_grids.prior.hit_prior(rays.laser, rays.fraction, near[:_BESIDE]) - 0.5,
        is_met - 0.5,
        np.log1p(range_m) / 2.0 - 1.0,
        range_m / 40.0,
        share[:, SAME] - 0.5,
        share[:, THROUGH],
        share[:, EMPTY],
        share[:, BESIDE] - 0.5,
        share_beside[:, SAME] - 0.5,
        share_beside[:, EMPTY],
        shine,
        rendered.intensity,
        level,
    )
    assert len(channels) == FEATURES
    column = torch.from_numpy(_upright(scan_grids.table, rays))
    stacked = torch.from_numpy(np.stack(channels).astype(np.float32)).reshape(FEATURES, lasers, firings)
    hit_prior = torch.from_numpy(rendered.hit_prior).reshape(lasers, firings)
    return SweepCells(
        column=column,
        features=torch.gather(stacked, 2, column.expand(FEATURES, -1, -1)),
        prior_logit=probability_logit(torch.gather(hit_prior, 1, column), _VOTE_LIMIT),
        is_met=torch.gather(torch.from_numpy(is_met).reshape(lasers, firings), 1, column),
    )


def _upright(table: LaserTable, rays: SweepRays) -> np.ndarray:
    """(l, f) int64: each laser's firings in the order that puts one azimuth into one column.

    Lasers that fire together look apart, by up to a twentieth of a turn.
    """
    _, firings = rays.shape
    shift_steps = (table.phase_steps - table.firing_shift_steps)[rays.laser[::firings]]
    ahead = np.rint(shift_steps * firings / table.lattice_steps).astype(np.int64)
    columns: np.ndarray = (np.arange(firings)[None, :] + ahead[:, None]) % firings
    return columns
