"""How far an estimated path is from the commanded one, step by step."""

import numpy as np

from nvsf_core.errors import ShapeError
from nvsf_core.geometry.se3 import invert_pose


def step_error_m(estimated: np.ndarray, commanded: np.ndarray) -> float:
    """Median over the steps from scan to scan of the error of the step's translation, metres.

    A step is the pose of a scan in the frame of the one before, so where the paths start does not matter.

    Args:
        estimated: (n, 4, 4) sensor to any world.
        commanded: (n, 4, 4) sensor to world, of the same scans.

    Raises:
        ShapeError: The paths have different lengths, or fewer than two poses.
    """
    if estimated.shape != commanded.shape or len(commanded) < 2:
        raise ShapeError(
            f"paths: expected two of the same n > 1 poses, found {estimated.shape} and {commanded.shape}"
        )
    one, other = (invert_pose(path[:-1]) @ path[1:] for path in (estimated, commanded))
    error_m = np.linalg.norm((invert_pose(other) @ one)[:, :3, 3], axis=1)
    return float(np.median(error_m))
