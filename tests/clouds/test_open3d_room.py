"""open3d is loaded without its drawing, which who asks for it still gets."""

import sys
from collections.abc import Callable
from subprocess import CompletedProcess

import pytest

_LOADS = """
import sys
from nvsf_core.clouds.open3d_room import load_open3d
assert load_open3d().geometry.PointCloud and load_open3d() is sys.modules["open3d"]
print("dash" in sys.modules)
import open3d.visualization
print(open3d.visualization.draw_plotly.__name__)
"""


@pytest.mark.usefixtures("open3d")
def test_drawing_is_loaded_only_where_it_is_asked_for(
    run_process: Callable[..., CompletedProcess[str]],
) -> None:
    done = run_process(sys.executable, "-c", _LOADS)
    assert done.stdout.split() == ["False", "draw_plotly"], done.stderr
