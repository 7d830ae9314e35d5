"""What tests over open3d need."""

import pytest

from nvsf_core.clouds.open3d_room import load_open3d
from nvsf_core.errors import MissingLibraryError


@pytest.fixture
def open3d() -> None:
    """Where open3d's system libraries are missing the test is left out, and says what to install."""
    try:
        load_open3d()
    except MissingLibraryError as error:
        pytest.skip(str(error))
