"""The process that reconstructs a surface may end badly."""

import numpy as np
import pytest

from nvsf_core.clouds.poisson import poisson_surface
from nvsf_core.errors import DataError

pytestmark = pytest.mark.usefixtures("open3d")


def test_an_ended_poisson_process_is_told_with_its_exit_code() -> None:
    with pytest.raises(DataError, match=r"ended with exit code -?\d+ and no surface"):
        poisson_surface(np.zeros((1, 2)), np.zeros((1, 2)), depth=4)
