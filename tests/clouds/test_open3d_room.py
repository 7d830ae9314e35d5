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
{asks}
print(open3d.visualization.draw_plotly.__name__, hasattr(open3d, "nothing_of_this_name"))
"""


@pytest.mark.usefixtures("open3d")
@pytest.mark.parametrize("asks", ["import open3d", "import open3d.visualization"])
def test_drawing_is_loaded_only_where_it_is_asked_for(
    run_process: Callable[..., CompletedProcess[str]], asks: str
) -> None:
    done = run_process(sys.executable, "-c", _LOADS.replace("{asks}", asks))
    assert done.stdout.split() == ["False", "draw_plotly", "False"], done.stderr
