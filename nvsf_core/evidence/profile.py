"""Describes a scene in figures and words: extent, surface, moving objects."""

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.evidence.surfels import Surfels


def scene_profile(evidence: SceneEvidence, cameras: list[str], duration_s: float) -> dict[str, Scalar]:
    """Figures of a scene, by name, and `profile`, a summary in words; the same for all recipes.

    Args:
        evidence: Of the training scans.
        cameras: Names of the cameras with a usable image.
        duration_s: Seconds from the first to the last training scan.
    """
    surfels = evidence.surfels
    voxel_m = surfels.index.voxel_m
    proven_m2 = surface_m2(surfels)
    spacing_m = point_spacing_m(surfels)
    motion = _motion(evidence, duration_s)
    # Not the extremes: a stray return far away bounds nothing.
    low, high = np.percentile(surfels.mean_m, (0.5, 99.5), axis=0)
    sensors = f"LiDAR and {', '.join(cameras)}" if cameras else "LiDAR, no camera"
    return {
        "profile": f"{motion_in_words(evidence)}; {sensors}; about "
        f"{proven_m2:,.0f} m2 of surface, seen by points {100 * spacing_m:.0f} cm apart",
        **motion,
        "cameras": len(cameras),
        "voxels": len(surfels.hits),
        "voxel_m": voxel_m,
        "surface_m2": proven_m2,
        "point_spacing_m": spacing_m,
        **{f"extent_{axis}_m": float(size) for axis, size in zip("xyz", high - low, strict=True)},
    }


def motion_in_words(evidence: SceneEvidence | None) -> str:
    """Whether the scene has moving objects, and how many of them need a flow; in words."""
    if evidence is None:
        return "unknown without LiDAR: taken as static, no time branch"
    if evidence.dynamic is None:
        return "static street: no time branch"
    count, flowing = len(evidence.dynamic.objects), evidence.dynamic.flowing
    flows = "no flow" if flowing == 0 else f"a flow for {flowing} that no rigid motion explains"
    return f"dynamic: {count} moving object{'s' if count > 1 else ''}, each in its own frame, {flows}"


def surface_m2(surfels: Surfels) -> float:
    """Approximate area of proven surface: one face of every voxel that holds a return."""
    return len(surfels.hits) * surfels.index.voxel_m**2


def point_spacing_m(surfels: Surfels) -> float:
    """Median distance between neighbouring returns on a surface, in metres: voxel edge / sqrt(hits).

    The median is over returns, not over voxels, because distant voxels are nearly empty.
    """
    order = np.argsort(surfels.hits)
    share = np.cumsum(surfels.hits[order].astype(np.float64))
    middle = order[int(np.searchsorted(share, 0.5 * share[-1]))]
    return float(surfels.index.voxel_m / np.sqrt(max(float(surfels.hits[middle]), 1.0)))


def _motion(evidence: SceneEvidence, duration_s: float) -> dict[str, Scalar]:
    """How many objects move, and their share of the returns and of the drive's time."""
    if evidence.dynamic is None:
        return {"moving_objects": 0}
    objects = evidence.dynamic.objects
    hits = sum(int(one.rays.is_hit.sum()) for one in objects)
    spans = np.array([(one.path.time_s.min(), one.path.time_s.max()) for one in objects])
    places = np.concatenate([one.path.pose[:, :2] for one in objects])
    low, high = places.min(axis=0), places.max(axis=0)
    return {
        "moving_objects": len(objects),
        "moving_returns_share": hits / float(evidence.surfels.hits.sum()),
        "moving_time_share": float(np.clip(_covered_s(spans) / max(duration_s, 1e-9), 0.0, 1.0)),
        "moving_objects_with_flow": evidence.dynamic.flowing,
        "moving_where": f"x {low[0]:.0f} to {high[0]:.0f} m, y {low[1]:.0f} to {high[1]:.0f} m of the scene",
    }


def _covered_s(spans: np.ndarray) -> float:
    """Length of the union of intervals (n, 2), seconds."""
    total, end = 0.0, -np.inf
    for first, last in spans[np.argsort(spans[:, 0])]:
        total += max(0.0, float(last - max(first, end)))
        end = max(end, float(last))
    return total
