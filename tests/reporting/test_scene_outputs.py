"""A view's pictures stand beside their own truth."""

import sys
from pathlib import Path

import numpy as np

from nvsf_core.reporting.scene_outputs import collect_scene
from nvsf_core.stages.scoring.view_images import TrueImages, write_truth
from nvsf_core.stores.arrays import write_arrays

sys.path.insert(0, str(Path(__file__).parent))
from street_store import write_street  # tests are no package


def test_pictures_on_a_path_of_its_own_stand_beside_the_truth_of_their_instant(tmp_path: Path) -> None:
    store = write_street(tmp_path, "street")
    views, metrics = store.path("novel_views/quick/0"), store.path("scene_metrics/quick/0")
    rgb = np.arange(3, dtype=np.uint8)[:, None, None, None] * np.ones((1, 8, 8, 3), np.uint8)  # its instant
    true = TrueImages(
        camera="image_00", row=np.array([1, 2]), frame=np.array([10, 14]), rgb=rgb[1:],
        valid=np.ones((8, 8), bool),
    )  # fmt: skip
    # The frames nearest in place are others: of one instant the other's, of one none that has a truth.
    for view, nearest in (("ahead", [10, 14, 18]), ("far", [20, 20, 20])):
        for method in ("model", "reproject"):
            arrays = {"frame": np.array(nearest), "image_00_rgb": rgb, "image_00_frame": np.array(nearest)}
            write_arrays(views / view / f"{method}.zarr", arrays, {"sensor": "", "cameras": ["image_00"]})
        write_truth(metrics / view, [true])
    (run,) = collect_scene(tmp_path, "street").runs
    for view in ("ahead", "far"):
        (pair,) = next(one for one in run.pictures if one.view == view).cameras
        shown = [pair.truth, *pair.rendered.values()]
        assert [image is not None and int(image[0, 0, 0]) for image in shown] == [2, 2, 2]
        assert pair.frame == 14
