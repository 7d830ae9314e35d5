import numpy as np
import pytest

from nvsf_core.errors import ShapeError
from nvsf_core.geometry.se3 import exp_se3
from nvsf_core.metrics.trust.path_error import step_error_m


def _path(step_m: float, turn_rad: float = 0.02) -> np.ndarray:
    """Ten poses on an arc."""
    step = exp_se3(np.array([[step_m, 0.0, 0.0, 0.0, 0.0, turn_rad]]))[0]
    poses = [np.eye(4)]
    for _ in range(9):
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def test_where_a_path_starts_does_not_matter_and_each_step_that_is_too_long_does() -> None:
    commanded = _path(1.0)
    elsewhere = exp_se3(np.array([[3.0, -2.0, 0.5, 0.1, 0.2, 1.5]]))[0] @ commanded
    assert step_error_m(elsewhere, commanded) == pytest.approx(0.0, abs=1e-9)
    assert step_error_m(_path(1.1), commanded) == pytest.approx(0.1, rel=0.01)


def test_paths_of_other_lengths_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"found \(9, 4, 4\) and \(10, 4, 4\)"):
        step_error_m(_path(1.0)[1:], _path(1.0))
