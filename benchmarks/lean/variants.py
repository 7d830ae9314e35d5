"""What `lean` does without, as steps of its own training: heuristic sampling, L_grad, another range loss."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nvsf_core.errors import ShapeError
from nvsf_core.evidence.raydrop.prior import find_cells
from nvsf_core.evidence.static.surfels import Surfels
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.fields.surface_batch import surface_batch
from nvsf_core.losses.gradient import gradient_loss
from nvsf_core.losses.gradient_mask import double_gradient_mask
from nvsf_core.losses.lidar import CLAMP_M, depth_loss, intensity_loss, raydrop_loss
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.models.residual.training_rays import LidarRays, learned_scans
from nvsf_core.recipe import PaperRecipe, ResidualRecipe
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.lidar import LidarRender, render_lidar
from nvsf_core.rendering.reproject import NEAR_M
from nvsf_core.sampling.error_map import LIDAR_CELL_PX, ErrorMap
from nvsf_core.sampling.patches import patch_pixels, uniform_corners

PAPER = PaperRecipe(name="paper")
"""Patch and threshold of the double-gradient mask are the paper's."""
PATCH = PAPER.sampling.patches or (1, 1)
TAU_M = PAPER.gradient.threshold_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """One thing that training does otherwise."""

    name: str
    heuristic: bool = False
    """Every second step draws in proportion to the last seen errors, not evenly."""
    patches: bool = False
    """Every second step draws patches of 2 lasers x 8 firings, not single rays."""
    gradient: float = 0.0
    """Weight of L_grad on these patches, metres to metres of the depth's."""
    huber_m: float = 0.0
    """Below it the range error counts squared; 0 = never, as in the recipe."""
    log2_table: int | None = None
    """Entries a level, whatever the scene fills; None = what the recipe gives the scene."""
    shaped: bool = False
    """The field starts from the surfaces of `reproject`, where voxels' returns have shapes."""


VARIANTS = (
    Variant(name="as it is"),
    Variant(name="heuristic sampling", heuristic=True),
    Variant(name="patches, L_grad x 1", patches=True, gradient=1.0),
    Variant(name="heuristic patches, L_grad x 1", heuristic=True, patches=True, gradient=1.0),
    Variant(name="range loss squared below 5 cm", huber_m=0.05),
    Variant(name="2^18 entries a level", log2_table=18),
    Variant(name="patches, L_grad x 0.1", patches=True, gradient=0.1),
    Variant(name="2^19 entries a level", log2_table=19),
    Variant(name="patches, no L_grad", patches=True),
    Variant(name="surfaces with shapes", shaped=True),
)
"""The first is the recipe's own training."""


@dataclass(frozen=True, slots=True, eq=False)
class RayGrid:
    """Where training rays lie in the sensor's own grid: all scans' lasers, stacked, by firings."""

    ray: np.ndarray
    """(scans * lasers, firings) int64; -1 where no ray is trained on (own vehicle, beyond reach)."""
    lasers: int
    """Rows a scan, an even number: no cell of an error map belongs to two scans."""
    range_m: Tensor
    """The same shape, 0 = no return or no ray."""
    mask_x: Tensor
    """The same shape, bool: where ranges along a row are compared; both rays are trained on."""
    mask_y: Tensor
    """Likewise to the next laser of the same scan."""

    @property
    def is_ray(self) -> Tensor:
        """The same shape, bool."""
        return torch.from_numpy(self.ray >= 0)


def ray_grid(lidar: LidarRecording, rays: LidarRays) -> RayGrid:
    """Find each of `training_rays`' rays in the grid of lasers (from the top) and firings.

    Raises:
        ShapeError: The rays are not this recording's.
    """
    scans = [_cells_of(lidar, number, scan) for number, scan in learned_scans(lidar)]
    count = sum(len(laser) for laser, _ in scans)
    if count != len(rays):
        raise ShapeError(f"ray grid: expected {count} rays of {len(scans)} scans, found {len(rays)}")
    lasers = len(lidar.evidence.lasers) + len(lidar.evidence.lasers) % 2
    ray = np.full((len(scans), lasers, lidar.evidence.prior.fraction.shape[1]), -1, np.int64)
    first = 0
    for number, (laser, column) in enumerate(scans):
        known = laser >= 0
        ray[number, laser[known], column[known]] = first + np.flatnonzero(known)
        first += len(laser)
    range_m = torch.from_numpy(np.where(ray >= 0, rays.range_m[ray], np.float32(0.0)))
    mask_x, mask_y = double_gradient_mask(range_m, TAU_M)
    there = torch.from_numpy(ray >= 0)
    mask_x &= there & there.roll(-1, dims=2)
    mask_y &= there & there.roll(-1, dims=1)
    mask_x[:, :, -1] = False
    mask_y[:, -1] = False
    rows = (len(scans) * lasers, ray.shape[2])
    return RayGrid(ray.reshape(rows), lasers, *(x.reshape(rows) for x in (range_m, mask_x, mask_y)))


def _cells_of(lidar: LidarRecording, number: int, scan: int) -> tuple[np.ndarray, np.ndarray]:
    """Laser rows and firings of a training scan's rays in the order of `training_rays`; rows -1 = unknown."""
    a, evidence, part = lidar.sweeps.arrays, lidar.evidence, lidar.sweeps.returns_of(scan)
    kept = lidar.sweeps.is_of_world(part) & (a["laser"][part] >= 0)
    row_of = np.full(evidence.prior.laser_count, -1, np.int64)
    row_of[evidence.lasers] = np.arange(len(evidence.lasers))
    _, cells = find_cells(
        a["laser"][part], a["firing"][part], a["sweep_fraction"][part],
        np.array([0, part.stop - part.start]), a["firings"][scan : scan + 1],
        nominal_firings=lidar.sweeps.table.firings_per_turn,
    )  # fmt: skip
    laser = np.where(cells.is_known, row_of[a["laser"][part]], -1)[kept]
    firings = evidence.prior.firings_of(number)
    empty_laser, empty_column = np.nonzero(~evidence.prior.is_hit[number][evidence.lasers][:, :firings])
    return np.concatenate([laser, empty_laser]), np.concatenate([cells.column[kept], empty_column])


class VariantStep:
    """Draws rays as a variant says, renders them, and compares them with what was recorded."""

    def __init__(
        self,
        variant: Variant,
        field: LidarField,
        surfels: Surfels,
        rays: LidarRays,
        recipe: ResidualRecipe,
        far_m: float,
        grid: RayGrid,
    ) -> None:
        """Of one training; the surfels are of what stands."""
        self.variant, self.field, self.surfels, self.rays = variant, field, surfels, rays
        self.recipe, self.far_m, self.grid = recipe, far_m, grid
        self.errors = ErrorMap(1, *grid.ray.shape, LIDAR_CELL_PX, grid.is_ray) if variant.heuristic else None
        self.place = np.full((len(rays), 2), -1, np.int64)
        row, column = np.nonzero(grid.ray >= 0)
        self.place[grid.ray[row, column]] = np.stack([row, column], axis=1)

    def __call__(self, step: int, generator: torch.Generator) -> list[LossBreakdown]:
        """The step's loss; the error map learns from every step."""
        if step % 2 == 1 or not (self.variant.heuristic or self.variant.patches):
            drawn = torch.randint(len(self.rays), (self.recipe.lidar_training.rays,), generator=generator)
            return [self._loss(drawn.numpy(), None)]
        cells = self._cells(generator)
        return [self._loss(self.grid.ray[cells], cells if self.variant.patches else None)]

    def _cells(self, generator: torch.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Rows and firings of the rays of a step that is not even over rays."""
        count, shape = self.recipe.lidar_training.rays, self.grid.ray.shape
        if not self.variant.patches:
            assert self.errors is not None
            row, column = self.errors.sample_pixels(0, count, generator)
            return row.numpy(), column.numpy()
        patches = count // (PATCH[0] * PATCH[1])
        if self.errors is None:
            corners = uniform_corners(shape, PATCH, patches, generator)
        else:
            corners = self.errors.sample_patches(0, patches, PATCH, generator)
        row, column = patch_pixels(*corners, PATCH, shape)
        return row.flatten().numpy(), column.flatten().numpy()

    def _loss(self, ray: np.ndarray, cells: tuple[np.ndarray, np.ndarray] | None) -> LossBreakdown:
        """Of rays (r,); -1 in a patch is a place without one, and teaches nothing."""
        is_ray, drawn = torch.from_numpy(ray >= 0), np.maximum(ray, 0)
        rays, recipe = self.rays, self.recipe
        batch = surface_batch(
            self.surfels, rays.origin_m[drawn], rays.direction[drawn],
            most=recipe.evidence.lidar_candidates, near_m=NEAR_M, far_m=self.far_m,
            objects=None if rays.objects is None else rays.objects.of(drawn),
        )  # fmt: skip
        rendered = render_lidar(self.field, batch, torch.from_numpy(rays.hit_prior[drawn]))
        true_range_m = torch.from_numpy(rays.range_m[drawn])
        seen = batch.is_there[:, 0] & is_ray
        returned = (true_range_m > 0) & seen
        terms = {
            "depth": self._depth(rendered, true_range_m, returned),
            "hit": raydrop_loss(rendered.hit_logit[seen], (true_range_m[seen] > 0).float()),
            "intensity": intensity_loss(
                rendered.intensity_logit[returned], torch.from_numpy(rays.intensity[drawn])[returned]
            ),
        }
        weights = {name: getattr(recipe.losses, name) for name in terms}
        if self.errors is not None:
            self._remember(drawn, seen, returned, {name: weights[name] * terms[name] for name in terms})
        if cells is not None and self.variant.gradient:
            terms["gradient"] = self._gradient(rendered, seen, cells)
            weights["gradient"] = self.variant.gradient
        return total_loss(terms, weights)

    def _depth(self, rendered: LidarRender, true_range_m: Tensor, returned: Tensor) -> Tensor:
        weights, range_m, truth = (
            rendered.weights[returned],
            rendered.range_m[returned],
            true_range_m[returned],
        )
        if self.variant.huber_m:
            return huber_depth_loss(weights, range_m, truth, self.variant.huber_m)
        return depth_loss(weights, range_m, truth)

    def _gradient(self, rendered: LidarRender, seen: Tensor, cells: tuple[np.ndarray, np.ndarray]) -> Tensor:
        """L_grad of the patches; a ray's range is the mean of its surfaces' by their weights."""
        total = rendered.weights.sum(dim=1)
        mean_m = (rendered.weights * rendered.range_m).sum(dim=1) / total.clamp_min(1e-6)
        shape = (-1, *PATCH)
        # Where no evidence lies along a ray nothing is rendered, and nothing is compared.
        there = seen.view(shape)
        mask_x, mask_y = (mask[cells].view(shape) & there for mask in (self.grid.mask_x, self.grid.mask_y))
        mask_x[:, :, :-1] &= there[:, :, 1:]
        mask_y[:, :-1] &= there[:, 1:]
        return gradient_loss(
            mean_m.view(shape), self.grid.range_m[cells].view(shape), mask_x, mask_y, PAPER.gradient.norm
        )

    def _remember(self, drawn: np.ndarray, seen: Tensor, returned: Tensor, terms: dict[str, Tensor]) -> None:
        """Tell the map each ray's weighted loss, L_grad left out as in the paper."""
        assert self.errors is not None
        error = torch.zeros(len(drawn))
        error[seen] += terms["hit"].detach()
        error[returned] += (terms["depth"] + terms["intensity"]).detach()
        row, column = torch.from_numpy(self.place[drawn]).T
        known = seen & (row >= 0)
        self.errors.update(0, row[known], column[known], error[known])


def huber_depth_loss(weights: Tensor, range_m: Tensor, true_range_m: Tensor, below_m: float) -> Tensor:
    """As `depth_loss`, errors below `below_m` squared: e^2 / (2 d), above e - d / 2; metres (r,)."""
    error = (range_m - true_range_m[:, None]).abs().clamp_max(CLAMP_M)
    smooth = torch.where(error < below_m, error**2 / (2.0 * below_m), error - 0.5 * below_m)
    return (weights * smooth).sum(dim=1) + CLAMP_M * (1.0 - weights.sum(dim=1))
