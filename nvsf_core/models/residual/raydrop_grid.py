"""The raydrop network: hit probabilities on the recording sensor's own grid of lasers and firings.

Its inputs are the hit prior, a lookup in the nearest other scans at the point where a ray is expected to end,
and the field's range and intensity. The hit probability of the field's ray head is not among them: it is too
good on the training scans, and a network trained with it would trust it too much elsewhere. Network and ray
head err differently, so their logits are blended (`HitBlend`).
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from nvsf_core.errors import ShapeError
from nvsf_core.fields.layers import CellNetwork
from nvsf_core.kernels.scan_lookup import BESIDE, EMPTY, SAME, SHINE, THROUGH
from nvsf_core.numerics import probability_logit
from nvsf_core.recording.drive import ScanLookups, ray_ends_m
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.sweep import SweepRays
from nvsf_core.sensors.tables import LaserTable
from nvsf_core.simulation.raydrop import HitBlend

FEATURES = 14
"""Input channels of the network."""
_NEAREST = 2
"""Of the scans that are looked up, those nearest in time, which are counted by themselves too."""
_PRIOR_LIMIT, _HIT_LIMIT = 0.02, 0.003


@dataclass(frozen=True, slots=True)
class SweepRaydrop:
    """Corrects the hit probabilities of sweeps of the recording sensor in its own place."""

    network: CellNetwork
    blend: HitBlend

    def __call__(self, rays: SweepRays, rendered: RenderedRays, lookups: ScanLookups) -> RenderedRays:
        """The same rays with new hit probabilities; looked up in the nearest scans."""
        both = hit_logits(self.network, rays, rendered, lookups)
        hit = expit(self.blend.logit(*both)).astype(np.float32)
        return replace(rendered, hit=np.where(is_corrected(rendered), hit, rendered.hit))


def is_corrected(rendered: RenderedRays) -> np.ndarray:
    """(r,) bool: the rays that meet a surface and do not end on a moving object."""
    met = np.isfinite(rendered.range_m)
    return met if rendered.on_object is None else met & ~rendered.on_object


@torch.no_grad()
def hit_logits(
    network: CellNetwork, rays: SweepRays, rendered: RenderedRays, lookups: ScanLookups
) -> tuple[np.ndarray, np.ndarray]:
    """Logits (r,) float32 of a return for each ray of a sweep, by the network and by the ray head."""
    cells = sweep_cells(rays, rendered, lookups)
    learned = cells.prior_logit + network.corrections(cells.features)[0]
    back = torch.empty_like(learned).scatter_(1, cells.column, learned).reshape(-1)
    return back.numpy(), probability_logit(torch.from_numpy(rendered.hit), _HIT_LIMIT).numpy()


@dataclass(frozen=True, slots=True)
class SweepCells:
    """The network's inputs for one sweep of the recording sensor; a column is an azimuth."""

    column: Tensor
    """(l, f) int64: number of the firing that each cell is."""
    features: Tensor
    """(FEATURES, l, f) float32, each about -1..1."""
    prior_logit: Tensor
    """(l, f) float32: logit of the hit prior."""
    is_met: Tensor
    """(l, f) bool: whether the ray meets a surface that it could return from."""


def sweep_cells(rays: SweepRays, rendered: RenderedRays, lookups: ScanLookups) -> SweepCells:
    """The network's inputs; arguments as of `hit_logits`. The ray head's hit probabilities are not used.

    Raises:
        ShapeError: The rendered rays have no hit prior.
    """
    if rendered.hit_prior is None:
        raise ShapeError(
            "sweep_cells: expected rays with hit priors, found none; a field's renderer gives them"
        )
    lasers, firings = rays.shape
    is_met = np.isfinite(rendered.range_m)
    range_m = np.where(is_met, rendered.range_m, 0.0).astype(np.float32)
    scan_grids, near = lookups.scan_grids, lookups.scans
    found = lookups.at(ray_ends_m(rays, rendered.range_m))
    nearest, asked = (
        np.where(is_met[:, None], some.sum(axis=0), np.float32(0.0)) for some in (found[:_NEAREST], found)
    )
    share = asked / np.float32(len(near))
    share_nearest = nearest / np.float32(min(len(near), _NEAREST))
    shine = asked[:, SHINE] / np.maximum(asked[:, SAME], 1.0)
    nearest_prior = scan_grids.prior.hit_prior_of_sweep(
        rays.laser[::firings], rays.fraction[:firings], near[:_NEAREST]
    )
    level = np.repeat(np.linspace(-1.0, 1.0, lasers, dtype=np.float32), firings)
    channels = (
        rendered.hit_prior - 0.5,
        nearest_prior.reshape(-1) - 0.5,
        is_met - 0.5,
        np.log1p(range_m) / 2.0 - 1.0,
        range_m / 40.0,
        share[:, SAME] - 0.5,
        share[:, THROUGH],
        share[:, EMPTY],
        share[:, BESIDE] - 0.5,
        share_nearest[:, SAME] - 0.5,
        share_nearest[:, EMPTY],
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
        prior_logit=probability_logit(torch.gather(hit_prior, 1, column), _PRIOR_LIMIT),
        is_met=torch.gather(torch.from_numpy(is_met).reshape(lasers, firings), 1, column),
    )


def _upright(table: LaserTable, rays: SweepRays) -> np.ndarray:
    """(l, f) int64: each laser's firings, shifted so that a column is one azimuth.

    Lasers that fire together differ in azimuth by up to a twentieth of a rotation.
    """
    _, firings = rays.shape
    shift_steps = (table.phase_steps - table.firing_shift_steps)[rays.laser[::firings]]
    ahead = np.rint(shift_steps * firings / table.lattice_steps).astype(np.int64)
    return (np.arange(firings)[None, :] + ahead[:, None]) % firings
