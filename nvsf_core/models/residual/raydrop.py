"""Trains the raydrop network on the sensor's own grid, and blends it with the field's ray head."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import torch

from nvsf_core._types import Scalar
from nvsf_core.evidence.surfels import Surfels
from nvsf_core.fields.layers import CellNetwork
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.kernels.threads import in_parts
from nvsf_core.models.family import TrainedPart, TrainingSession, fit, training_device
from nvsf_core.models.holdout import compare, fire_left_out
from nvsf_core.models.residual.cell_step import CellExample, cell_step
from nvsf_core.models.residual.lidar import learned_scans
from nvsf_core.models.residual.raydrop_grid import (
    SweepCells,
    SweepRaydrop,
    hit_logits,
    is_corrected,
    sweep_cells,
)
from nvsf_core.recipe.residual import ResidualRecipe
from nvsf_core.recording.drive import LidarRecording, ScanLookups
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.sweep import SweepRays
from nvsf_core.simulation.ray_renderers import field_renderer
from nvsf_core.simulation.raydrop import HitBlend, fit_blend, nats
from nvsf_core.simulation.scene_model import SweepCorrector
from nvsf_core.training.loop import fresh_state, side_by_side

HITS_BLEND = "hits_blend"
"""Name of the fact: the fields of `HitBlend`; None where the ray head alone gives the hit probability."""
_FEWEST_VALIDATED = 2
"""A blend is scored on validation scans that it was not fitted on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainedHits(TrainedPart):
    """The trained part, and the network ready for use."""

    correct: SweepRaydrop | None
    """None where the network is not used."""


@dataclass(frozen=True, slots=True, eq=False)
class ValidationSweep:
    """The r rays of a validation scan: what network and ray head predict, and what was recorded."""

    network_logit: np.ndarray
    """(r,) float32."""
    ray_head_logit: np.ndarray
    """(r,) float32."""
    is_corrected: np.ndarray
    """(r,) bool, see `is_corrected`; the other rays take no part in the comparison."""
    returned: np.ndarray
    """(r,) bool, as recorded."""

    def accuracy(self, logit: np.ndarray) -> float:
        """Share of the corrected rays that are predicted correctly, return or dropped, by logits (r,)."""
        return float(((logit >= 0.0) == self.returned)[self.is_corrected].mean())

    def nats(self, logit: np.ndarray) -> float:
        """Mean cross-entropy of logits (r,) over the corrected rays, in nats."""
        return nats(logit[self.is_corrected], self.returned[self.is_corrected])

    def scores(self, logit: np.ndarray) -> list[float]:
        """Accuracy and cross-entropy of logits (r,)."""
        return [self.accuracy(logit), self.nats(logit)]


def train_hits(
    session: TrainingSession, network: CellNetwork, field: LidarField, recipe: ResidualRecipe,
    lidar: LidarRecording,
) -> TrainedHits:  # fmt: skip
    """Train the network on the field's training scans, then decide on the validation scans whether to use it.

    Without validation scans nothing is trained.

    Args:
        session: Of the scene.
        network: Is trained.
        field: Already trained.
        recipe: With `hits`.
        lidar: The recording.
    """
    spec, left_out = recipe.hits, lidar.evidence.left_out
    assert spec is not None
    if left_out is None or len(left_out.validation) < _FEWEST_VALIDATED:
        few: dict[str, Scalar] = {"hits_shown": "ray head: too few scans to compare a network on"}
        return TrainedHits(
            states={}, preparation_seconds=0.0, metadata=few, facts={HITS_BLEND: None}, correct=None
        )
    started, device = time.perf_counter(), training_device()
    network.to(device)
    learned = [number for number, _ in learned_scans(lidar)]
    chosen = np.unique(np.linspace(0, len(learned) - 1, spec.frames).round().astype(np.int64))
    session.say("hits", f"simulating {len(chosen)} training scans")
    examples = in_parts(
        lambda place: _example(field, recipe, lidar, learned[chosen[place]]).to(device),
        len(chosen),
    )
    preparation = time.perf_counter() - started
    state = fresh_state(network, spec.training, session.seed * 5 + 4)
    fit(
        session, "hits", state, spec.training,
        lambda _, generator: side_by_side(
            spec.training.parts, generator,
            lambda own: cell_step(network, examples, spec.training, recipe.losses, own),
        ),
    )  # fmt: skip
    validating = time.perf_counter()
    validated = in_parts(
        lambda place: _validation_sweep(
            field, recipe, lidar, network, int(left_out.validation[place]), left_out.static
        ),
        len(left_out.validation),
    )
    blend, metadata = blend_in_rotation(validated)
    preparation += time.perf_counter() - validating
    return TrainedHits(
        states={"hits": state}, preparation_seconds=preparation, metadata=metadata,
        facts={HITS_BLEND: None if blend is None else asdict(blend)},
        correct=None if blend is None else SweepRaydrop(network, blend),
    )  # fmt: skip


def blend_in_rotation(validated: Sequence[ValidationSweep]) -> tuple[HitBlend | None, dict[str, Scalar]]:
    """The blend of network and ray head, None where the ray head alone is better, and the scores.

    Each of the scans, at least two, is scored with a blend that was fitted on the others; the blend that is
    returned is fitted on all.
    """

    def blended(number: int) -> list[float]:
        one, others = validated[number], [other for place, other in enumerate(validated) if place != number]
        return one.scores(_fitted(others).logit(one.network_logit, one.ray_head_logit))

    found = compare(
        {"accuracy": True, "nats": False},
        range(len(validated)),
        {
            "blend": blended,
            "ray head": lambda number: validated[number].scores(validated[number].ray_head_logit),
        },
    )
    is_better = found.is_better("blend", "accuracy", "ray head")
    blend = _fitted(validated)
    metadata: dict[str, Scalar] = {
        **found.figures({"blend": "hits_judged_", "ray head": "hits_judged_ray_head_"}),
        "hits_blend": f"{blend.network:.2f} network {blend.ray_head:+.2f} ray head {blend.offset:+.2f}",
        "hits_shown": "network and ray head" if is_better else "ray head: learning did not beat it",
    }
    return blend if is_better else None, metadata


def _fitted(validated: Sequence[ValidationSweep]) -> HitBlend:
    """The blend fitted on the corrected rays of some scans."""
    parts = [(one.network_logit, one.ray_head_logit, one.returned, one.is_corrected) for one in validated]
    network, ray_head, returned, used = (np.concatenate(x) for x in zip(*parts, strict=True))
    return fit_blend(network[used], ray_head[used], returned[used])


def _example(field: LidarField, recipe: ResidualRecipe, lidar: LidarRecording, number: int) -> CellExample:
    """A training scan as the network learns it: hit prior and scan lookup without it, surfaces with it.

    Cells whose ray meets no surface have no weight.
    """
    found: list[SweepCells] = []

    def keep(rays: SweepRays, rendered: RenderedRays, lookups: ScanLookups) -> RenderedRays:
        found.append(sweep_cells(rays, rendered, lookups))
        return rendered

    rays, _ = _fire(field, recipe, lidar, lidar.evidence.static, number, keep)
    (cells,), prior = found, lidar.evidence.prior
    lasers, firings = rays.shape
    recorded = prior.nearest_firing(number, rays.fraction[:firings])[cells.column.numpy()]
    is_hit = prior.is_hit[number, rays.laser[::firings, None], recorded]
    return CellExample(
        features=cells.features,
        hit_logit=cells.prior_logit,
        intensity_logit=torch.zeros(lasers, firings),
        weight=cells.is_met.float(),
        returned=torch.from_numpy(is_hit),
        true_intensity=torch.zeros(lasers, firings),
    )


def _validation_sweep(
    field: LidarField, recipe: ResidualRecipe, lidar: LidarRecording, network: CellNetwork, number: int,
    static: Surfels,
) -> ValidationSweep:  # fmt: skip
    """A validation scan rendered from the surfaces `static` of the other scans, and its recorded hits."""
    found: list[tuple[np.ndarray, np.ndarray]] = []

    def keep(rays: SweepRays, rendered: RenderedRays, lookups: ScanLookups) -> RenderedRays:
        found.append(hit_logits(network, rays, rendered, lookups))
        return rendered

    rays, rendered = _fire(field, recipe, lidar, static, number, keep)
    ((network_logit, ray_head_logit),), prior = found, lidar.evidence.prior
    firing = prior.nearest_firing(number, rays.fraction)
    return ValidationSweep(
        network_logit, ray_head_logit, is_corrected(rendered), prior.is_hit[number, rays.laser, firing]
    )


def _fire(
    field: LidarField, recipe: ResidualRecipe, lidar: LidarRecording, static: Surfels, number: int,
    correct: SweepCorrector | None,
) -> tuple[SweepRays, RenderedRays]:  # fmt: skip
    """A training scan rendered by the field as if it were held out, but for what of it is in `static`."""
    moving = lidar.moving(leave_out=number)
    render = field_renderer(field, static, moving, most=recipe.evidence.lidar_candidates, far_m=lidar.far_m)
    return fire_left_out(render, recipe.evidence.votes, lidar, number, correct)
