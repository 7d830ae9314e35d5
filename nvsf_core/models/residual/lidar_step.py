"""Training steps of the residual LiDAR field: rays sampled from all training scans, and their loss."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import torch
from torch import Tensor

from nvsf_core.evidence.surfels import Surfels
from nvsf_core.fields.lidar_field import (
    LidarField,
    ObjectSurfaces,
    SurfaceBatch,
    join_surfaces,
    surface_batch,
)
from nvsf_core.losses.lidar import depth_loss, intensity_loss, raydrop_loss, surface_likelihood
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.recipe import ResidualRecipe
from nvsf_core.rendering.lidar import LidarRender, render_lidar
from nvsf_core.rendering.reproject import NEAR_M


@dataclass(frozen=True, slots=True)
class LidarRays:
    """n rays of the training frames, scene-local."""

    origin_m: np.ndarray
    """(n, 3) float32."""
    direction: np.ndarray
    """(n, 3) float32, unit."""
    range_m: np.ndarray
    """(n,) float32, metres; 0 = dropped."""
    intensity: np.ndarray
    """(n,) float32, 0..1; 0 = dropped."""
    hit_prior: np.ndarray
    """(n,) float32: share of the nearest other training scans that have a return there."""
    objects: ObjectSurfaces | None = None
    """Surfaces of moving objects, from the other scans, at these rays' times; None in a static scene."""

    def __len__(self) -> int:
        """Number of rays."""
        return len(self.range_m)


def join_rays(parts: list[LidarRays]) -> LidarRays:
    """Rays of several parts, one after the other; all of a ray lies together in memory, as it is sampled."""
    table = np.empty((sum(len(part) for part in parts), 9), np.float32)
    columns = {
        "origin_m": table[:, :3], "direction": table[:, 3:6], "range_m": table[:, 6],
        "intensity": table[:, 7], "hit_prior": table[:, 8],
    }  # fmt: skip
    for name, column in columns.items():
        np.concatenate([getattr(part, name) for part in parts], out=column)
    objects = [part.objects for part in parts if part.objects is not None]
    joined = join_surfaces(objects, [len(part) for part in parts]) if objects else None
    return LidarRays(**columns, objects=joined)


@dataclass(frozen=True, slots=True)
class LidarBatch:
    """n sampled training rays with the surfaces along them. Its rays' numbers are those in the batch."""

    surfaces: SurfaceBatch
    """Along the n rays."""
    true_range_m: Tensor
    """(n,) float32, metres; 0 = dropped."""
    true_intensity: Tensor
    """(n,) float32, 0..1; 0 = dropped."""
    hit_prior: Tensor
    """(n,) float32, see `LidarRays`."""
    met: Tensor
    """(m,) int64: rays with a surface."""
    returned: Tensor
    """(k,) int64: those of them with a return."""
    meets_object: Tensor | None
    """(k,) bool, of these: whether a surface is a moving object's; None if no surface of the batch is."""

    def to(self, device: torch.device) -> "LidarBatch":
        """The same batch on `device`."""
        meets = None if self.meets_object is None else self.meets_object.to(device)
        names = ("true_range_m", "true_intensity", "hit_prior", "met", "returned")
        tensors = {name: getattr(self, name).to(device) for name in names}
        return LidarBatch(self.surfaces.to(device), **tensors, meets_object=meets)


def sampled_batch(
    surfels: Surfels,
    rays: LidarRays,
    recipe: ResidualRecipe,
    far_m: float,
    generators: Sequence[torch.Generator],
) -> LidarBatch:
    """A part of a step's rays for each generator, one after the other, with the surfaces along them.

    Args:
        surfels: Of the static scene; moving objects come with the rays.
        rays: Of all training scans.
        recipe: Rays and parts a step, surfaces a ray.
        far_m: How far a ray is followed.
        generators: Sample the rays.
    """
    spec, most = recipe.lidar_training, recipe.evidence.lidar_candidates
    parts = [torch.randint(len(rays), (spec.rays // spec.parts,), generator=own) for own in generators]
    sampled = torch.cat(parts).numpy()
    surfaces = surface_batch(
        surfels, rays.origin_m[sampled], rays.direction[sampled], most=most, near_m=NEAR_M, far_m=far_m,
        objects=None if rays.objects is None else rays.objects.of(sampled),
    )  # fmt: skip
    range_m, intensity, hit_prior = (
        torch.from_numpy(column[sampled]) for column in (rays.range_m, rays.intensity, rays.hit_prior)
    )
    met = surfaces.is_there[:, 0]
    returned = (met & (range_m > 0)).nonzero()[:, 0]
    of_object = surfaces.hit_prior >= 0.0
    meets = None
    if bool(of_object.any()):
        meets = surfaces.spread(of_object.float()[:, None])[returned, :, 0].any(dim=1)
    return LidarBatch(surfaces, range_m, intensity, hit_prior, met.nonzero()[:, 0], returned, meets)


def lidar_step(field: LidarField, batch: LidarBatch, recipe: ResidualRecipe) -> LossBreakdown:
    """The loss of a batch of rays, which is a step or a part of one, on the field's device."""
    rendered = render_lidar(field, batch.surfaces, batch.hit_prior)
    # Which rays end on a moving object is known on the device only, and to ask it takes its time.
    corrected = batch.met if batch.meets_object is None else batch.met[~rendered.on_object[batch.met]]
    returned, is_return = batch.returned, (batch.true_range_m > 0).float()
    terms = {
        "depth": _depth(rendered, batch),
        "hit": raydrop_loss(rendered.hit_logit.index_select(0, corrected), is_return[corrected]),
        "intensity": intensity_loss(
            rendered.intensity_logit.index_select(0, returned), batch.true_intensity[returned]
        ),
    }
    return total_loss(terms, asdict(recipe.losses))


def _depth(rendered: LidarRender, batch: LidarBatch) -> Tensor:
    """Depth loss of each ray that returned: weighted range error, on moving objects a likelihood.

    A moving object is thin, met by few rays and mostly edges: there the weights must stay shares of rays.
    """
    of_returns = (
        rendered.weights.index_select(0, batch.returned),
        rendered.range_m.index_select(0, batch.returned),
        batch.true_range_m[batch.returned],
    )
    off_m = depth_loss(*of_returns)
    if batch.meets_object is None:
        return off_m
    return torch.where(batch.meets_object, surface_likelihood(*of_returns), off_m)
