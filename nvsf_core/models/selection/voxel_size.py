"""The voxel size of `reproject`, chosen by the range error on training scans that were left out."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.static.surfels import Surfels, build_surfels
from nvsf_core.recipe import EvidenceSpec
from nvsf_core.rendering.reproject import reproject_rays

FIELD_VOXEL_M = 0.2
"""Edge of the voxels that a field corrects: it makes nothing of finer ones, and its steps take longer."""
CANDIDATES_M = (0.2, 0.3)
"""From the finest with which a 64-laser sweep stays near 0.2 s on 2 cores. Where voxels' returns have shapes
finer ones give little: 0.15 m 1 to 2 % of the error, for 1.4 times the seconds."""
_JUDGES = 2
"""Training scans that are left out to judge."""
_FEWEST_SCANS = 6
"""With fewer training scans, two less are another scene: nothing is chosen."""
_RAYS_A_JUDGE = 20_000
_WORST_M = 1.0
"""What a ray is at most off by in the score."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanRays:
    """Returns of the training scans, but for the own vehicle's, scene-local."""

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

    def surfels(
        self, voxel_m: float, threads: int, chosen: slice | np.ndarray = slice(None), *, shaped: bool
    ) -> Surfels:
        """Of what stays, proven by chosen returns."""
        return build_surfels(
            self.origin_m[chosen], self.direction[chosen], self.range_m[chosen], self.intensity[chosen],
            voxel_m=voxel_m, threads=threads, is_surface=self.is_static[chosen], shaped=shaped,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class VoxelChoice:
    """What the judges say of each size that was tried."""

    errors_m: dict[float, float]
    """Size to mean absolute range error along the judges' recorded rays, metres, each ray's at most 1 m and
    1 m where there is no answer."""
    validation: np.ndarray
    """(2,) int64 numbers of the scans that judged."""
    static: Surfels
    """What stays, as all other scans prove it, for a field."""
    rendered: dict[float, Surfels]
    """Size to the same for the renderer that learns nothing."""

    @property
    def best_m(self) -> float:
        """The size with the smallest error."""
        return min(self.errors_m, key=lambda voxel_m: self.errors_m[voxel_m])


def choose_voxel_m(
    rays: ScanRays, *, unidentified: np.ndarray, far_m: float, threads: int
) -> VoxelChoice | None:
    """Score sizes on two training scans that the evidence is built without; coarser while it gets better.

    Args:
        rays: Of the training scans.
        unidentified: (s,) numbers of scans that are never left out: their lasers are not known.
        far_m: How far a ray is followed.
        threads: Of the walk.

    Returns:
        Only sizes that were tried. None where there is too little to judge.
    """
    scans = np.setdiff1d(np.flatnonzero(np.bincount(rays.scan)), unidentified)
    if len(scans) < _FEWEST_SCANS:
        return None
    validation = scans[(np.arange(1, _JUDGES + 1) * len(scans)) // (_JUDGES + 1)]
    is_validation = np.isin(rays.scan, validation)
    asked = np.flatnonzero(is_validation & rays.is_static)
    if len(asked) == 0:
        return None
    asked = asked[np.unique(np.linspace(0, len(asked) - 1, _JUDGES * _RAYS_A_JUDGE).astype(np.int64))]
    errors_m: dict[float, float] = {}
    rendered: dict[float, Surfels] = {}
    for voxel_m in CANDIDATES_M:
        rendered[voxel_m] = rays.surfels(voxel_m, threads, ~is_validation, shaped=True)
        errors_m[voxel_m] = mean_range_error_m(
            rendered[voxel_m], rays.origin_m[asked], rays.direction[asked], rays.range_m[asked],
            far_m=far_m, worst_m=_WORST_M,
        )  # fmt: skip
        if errors_m[voxel_m] > min(errors_m.values()):
            break
    static = rays.surfels(FIELD_VOXEL_M, threads, ~is_validation, shaped=False)
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
    """Mean absolute error of the ranges that surfels answer along rays (r, 3) that returned at (r,).

    Args:
        surfels: In the rays' frame.
        origin_m: (r, 3).
        direction: (r, 3) unit.
        range_m: (r,) to the return.
        far_m: How far a ray is followed.
        worst_m: Most that a ray counts as off, and what one without an answer counts: beyond, wrong is wrong.
    """
    rendered = reproject_rays(
        surfels, origin_m, direction, np.ones(len(range_m), np.float32),
        most=EvidenceSpec().lidar_candidates, far_m=far_m,
    )  # fmt: skip
    off_m = np.abs(rendered.range_m.astype(np.float64) - range_m)
    return float(np.minimum(np.where(np.isfinite(off_m), off_m, worst_m), worst_m).mean())
