"""Whether neighbouring scans agree with their poses: registered to each other they should not move."""

from collections.abc import Mapping

import numpy as np

from nvsf_core.clouds.open3d_room import registration_shift
from nvsf_core.errors import MissingLibraryError
from nvsf_core.stages.stage import Check

NAME = "neighbouring_scans_agree_with_their_poses"
MOST_SHIFT_M = 0.15
"""Of the median pair. Registration itself is good to a few centimetres on streets."""
MOST_TURN_DEG = 0.5
_PAIRS = 3
_THIN_M = 0.3
_NEAR_M, _FAR_M = 3.0, 40.0
_FEWEST_POINTS = 500


def registration_check(arrays: Mapping[str, np.ndarray]) -> Check:
    """Register some pairs of neighbouring scans by point-to-plane ICP, starting from their poses.

    Args:
        arrays: Of `sweeps/returns.zarr`.

    Returns:
        A check that warns and never blocks; where open3d cannot be loaded, its detail says "not run" and
        which package to install.
    """
    scans = len(arrays["frame"])
    first = np.linspace(0, scans - 2, _PAIRS).astype(np.int64) if scans > 1 else np.zeros(0, np.int64)
    pairs = [(k, k + 1) for k in np.unique(first).tolist()]
    clouds = {k: _thinned(arrays, k) for pair in pairs for k in pair}
    pairs = [pair for pair in pairs if min(len(clouds[k]) for k in pair) >= _FEWEST_POINTS]
    if not pairs:
        return Check(name=NAME, passed=True, detail="not run: no two neighbouring scans with enough returns")
    try:
        found = np.array([registration_shift(clouds[later], clouds[k]) for k, later in pairs])
    except MissingLibraryError as error:
        return Check(name=NAME, passed=True, detail=str(error))
    shift_m, turn_deg, share = np.median(found, axis=0)
    return Check(
        name=NAME,
        passed=bool(shift_m <= MOST_SHIFT_M and turn_deg <= MOST_TURN_DEG),
        detail=f"median of {len(pairs)} pairs: moved by {shift_m:.3f} m and {turn_deg:.2f} degrees, "
        f"{share:.0%} of the points matched; expected at most {MOST_SHIFT_M} m and {MOST_TURN_DEG} degrees, "
        "more means wrong poses or times",
    )


def _thinned(arrays: Mapping[str, np.ndarray], scan: int) -> np.ndarray:
    """Points (m, 3) of a scan, scene-local, one a voxel: near ones would outvote all others."""
    part = slice(int(arrays["offsets"][scan]), int(arrays["offsets"][scan + 1]))
    range_m = arrays["range_m"][part]
    used = ~arrays["is_own_vehicle"][part] & (range_m > _NEAR_M) & (range_m < _FAR_M)
    points = arrays["origin_m"][part][used] + arrays["direction"][part][used] * range_m[used, None]
    _, kept = np.unique(np.floor(points / _THIN_M).astype(np.int32), axis=0, return_index=True)
    found: np.ndarray = points[np.sort(kept)]
    return found
