"""A rendered view's scans, as data sets have them."""

import numpy as np

from nvsf_core.drives.view_entry import ViewEntry
from nvsf_core.recipe.presets import preset
from nvsf_core.stages.exports.of_view import RenderedView
from nvsf_core.stages.runner.stage import RunConfig

LASERS, FIRINGS = 4, 90


def test_times_of_a_scan_of_one_instant_have_no_sign() -> None:
    grid = np.full((1, LASERS, FIRINGS), 5.0)
    arrays = {
        "grid_range_m": grid, "grid_hit": np.ones_like(grid), "grid_intensity": 0.1 * grid,
        "grid_azimuth_rad": np.zeros_like(grid), "grid_elevation_rad": np.zeros_like(grid),
        "grid_support": np.ones(grid.shape, np.uint8), "grid_firings": np.array([FIRINGS]),
        "points_m": np.zeros((0, 3)), "frame": np.array([3]), "time_s": np.array([0.3]),
        "stamp_s": np.array([0.3]), "lidar_to_world": np.eye(4)[None],
    }  # fmt: skip
    attrs = {"grid_lasers": list(range(LASERS)), "sweep_period_s": 0.0}
    entry = ViewEntry(name="left", exports=("kitti",), hits="threshold")
    scan = RenderedView(
        scene="s", sequence="q", entry=entry, arrays=arrays, attrs=attrs,
        config=RunConfig(recipe=preset("smoke")),
    ).scan(0)  # fmt: skip
    assert len(scan.offset_s) == LASERS * FIRINGS
    # A reader that looks for other times than 0 in the bytes finds none.
    assert scan.offset_s.tobytes() == np.zeros(LASERS * FIRINGS, "<f4").tobytes()
