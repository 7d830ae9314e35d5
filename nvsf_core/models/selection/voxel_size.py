"""Chooses the voxel size of `reproject` by its range error on validation scans."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.static.surfels import Surfels, build_surfels
from nvsf_core.recipe import EvidenceSpec
from nvsf_core.rendering.reproject import reproject_rays

FIELD_VOXEL_M = 0.2
"""Edge of the voxels that a field corrects: finer ones do not lower its error and make its steps longer."""
CANDIDATES_M = (0.2, 0.3)
"""Tried in this order. With the first a sweep of 64 lasers takes about 0.2 s on 2 cores; 0.15 m would lower
the error by 1 to 2 % for 1.4 times the time."""
_VALIDATION_SCANS = 2
_FEWEST_SCANS = 6
"""With fewer training scans none can be spared for validation."""
_RAYS_A_SCAN = 20_000
_WORST_M = 1.0
"""Largest error of a ray in the score."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanRays:
    """Returns of the training scans, without the own vehicle's, scene-local."""

    origin_m: np.ndarray
    """(n, 3) float32."""
    direction: np.ndarray
    """(n, 3) float32, unit."""
    range_m: np.ndarray
    """(n,) float32."""
    intensity: np.ndarray
    """(n,) float32."""
    scan: np.ndarray
    """(n,) int64 number of the scan."""
    is_static: np.ndarray
    """(n,) bool: not of a moving object."""

    def surfels(self, voxel_m: float, chosen: slice | np.ndarray = slice(None), *, shaped: bool) -> Surfels:
        """Static surfels of the chosen returns; `shaped` as in `build_surfels`."""
        return build_surfels(
            self.origin_m[chosen], self.direction[chosen], self.range_m[chosen], self.intensity[chosen],
            voxel_m=voxel_m, is_surface=self.is_static[chosen], shaped=shaped,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class VoxelChoice:
    """The sizes that were tried: their errors, and the static surfels of all but the validation scans."""

    errors_m: dict[float, float]
    """For each size, the mean absolute range error along the validation scans' rays, metres; a ray counts at
    most 1 m, and 1 m if nothing is met."""
    validation: np.ndarray
    """(2,) int64 numbers of the validation scans."""
    static: Surfels
    """For a field."""
    rendered: dict[float, Surfels]
    """For `reproject`, for each size."""

    @property
    def best_m(self) -> float:
        """The size with the smallest error."""
        return min(self.errors_m, key=lambda voxel_m: self.errors_m[voxel_m])


def choose_voxel_m(rays: ScanRays, *, unidentified: np.ndarray, far_m: float) -> VoxelChoice | None:
    """Score voxel sizes on two training scans that the surfels are built without.

    Sizes are tried from the finest on; the first that is worse than one before it ends the search.

    Args:
        rays: Of the training scans.
        unidentified: (s,) numbers of scans that are never left out, because their lasers are unknown.
        far_m: How far a ray is followed.

    Returns:
        The sizes that were tried; None if there are fewer than six scans or no static return to compare.
    """
    scans = np.setdiff1d(np.flatnonzero(np.bincount(rays.scan)), unidentified)
    if len(scans) < _FEWEST_SCANS:
        return None
    validation = scans[(np.arange(1, _VALIDATION_SCANS + 1) * len(scans)) // (_VALIDATION_SCANS + 1)]
    is_validation = np.isin(rays.scan, validation)
    asked = np.flatnonzero(is_validation & rays.is_static)
    if len(asked) == 0:
        return None
    most = _VALIDATION_SCANS * _RAYS_A_SCAN
    asked = asked[np.unique(np.linspace(0, len(asked) - 1, most).astype(np.int64))]
    errors_m: dict[float, float] = {}
    rendered: dict[float, Surfels] = {}
    for voxel_m in CANDIDATES_M:
        rendered[voxel_m] = rays.surfels(voxel_m, ~is_validation, shaped=True)
        errors_m[voxel_m] = mean_range_error_m(
            rendered[voxel_m], rays.origin_m[asked], rays.direction[asked], rays.range_m[asked],
            far_m=far_m, worst_m=_WORST_M,
        )  # fmt: skip
        if errors_m[voxel_m] > min(errors_m.values()):
            break
    static = rays.surfels(FIELD_VOXEL_M, ~is_validation, shaped=False)
    return VoxelChoice(errors_m=errors_m, validation=validation, static=static, rendered=rendered)


def mean_range_error_m(
    surfels: Surfels,
    origin_m: np.ndarray,
    direction: np.ndarray,
    range_m: np.ndarray,
    *,
    far_m: float,
    worst_m: float,
) -> float:
    """Mean absolute range error in metres of surfels, rendered as `reproject` does along r recorded returns.

    Args:
        surfels: In the rays' frame.
        origin_m: (r, 3).
        direction: (r, 3) unit.
        range_m: (r,) recorded range.
        far_m: How far a ray is followed.
        worst_m: Largest error of a ray; also the error of one that meets nothing.
    """
    rendered = reproject_rays(
        surfels, origin_m, direction, np.ones(len(range_m), np.float32),
        most=EvidenceSpec().lidar_candidates, far_m=far_m,
    )  # fmt: skip
    off_m = np.abs(rendered.range_m.astype(np.float64) - range_m)
    return float(np.minimum(np.where(np.isfinite(off_m), off_m, worst_m), worst_m).mean())
