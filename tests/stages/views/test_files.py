"""One writer of scans: what is not finite is refused, whatever the format, and nothing of it is written."""

import json

import numpy as np
import pytest

from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.errors import DataError
from nvsf_core.recipe.presets import preset
from nvsf_core.stages.runner.record import RECORD_NAME, content_of, read_record
from nvsf_core.stages.runner.stage import RunConfig, Task
from nvsf_core.stages.views.files import file_numbers, scans_of, write_method, write_scans
from nvsf_core.stores.arrays import read_arrays
from nvsf_core.stores.checksums import file_checksums
from nvsf_core.stores.scene_store import SceneStore
from tests.clouds.ply_reader import read_ply

RECORD = {
    "fingerprint": "", "facts": {}, "version": "1", "previews": {}, "checks": [], "check_version": "",
    "files": {}, "resources": {}, "made_s": 0.0,
}  # fmt: skip
SCAN = np.arange(12, dtype=np.float32).reshape(3, 4) / 12.0


def test_a_scan_is_the_same_in_each_format(tmp_path):
    (files,) = write_scans(tmp_path, [7], [SCAN], ("bin", "ply"))
    assert files == {
        "bin": "velodyne_points/data/0000000007.bin",
        "ply": "velodyne_points/ply/0000000007.ply",
    }
    assert (np.fromfile(tmp_path / files["bin"], "<f4").reshape(-1, 4) == SCAN).all()
    points_m, intensity = read_ply(tmp_path / files["ply"])
    assert (points_m == SCAN[:, :3]).all() and (intensity == SCAN[:, 3]).all()


@pytest.mark.parametrize("kind", ["bin", "ply", "pcd"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_is_refused_and_not_written(tmp_path, kind, value):
    broken = SCAN.copy()
    broken[1, 3] = value
    with pytest.raises(DataError, match="scan 7: expected finite returns"):
        write_scans(tmp_path, [7], [broken], (kind,))
    assert list(tmp_path.iterdir()) == []


def test_scans_are_cut_where_the_arrays_say():
    arrays = {"points_m": SCAN[:, :3], "intensity": SCAN[:, 3], "offsets": np.array([0, 2, 3])}
    assert [len(scan) for scan in scans_of(arrays)] == [2, 1] and scans_of({}) == []


@pytest.mark.parametrize(("frame", "numbers"), [([5, 9], [5, 9]), ([5, 5], [0, 1])])
def test_files_are_numbered_by_frames_unless_two_share_one(frame, numbers):
    assert file_numbers({"frame": np.array(frame)}) == numbers


def test_an_image_of_a_frame_without_a_scan_has_its_own_number():
    held_out = {"number": np.array([2]), "frame": np.array([2]), "image_00_frame": np.array([1])}
    assert file_numbers(held_out) == [2] and file_numbers(held_out, "image_00") == [1]


@pytest.mark.parametrize("method", ["reproject", "model"])
def test_what_a_training_cost_is_no_content_of_its_views(tmp_path, method):
    """A home where the same model took other seconds, and another number of digits of them."""
    contents = []
    scene = SceneEntry(
        name="tiny", root=tmp_path, sequence="s", first_frame=0, last_frame=9, test_frames=(3,)
    )
    for seconds in (17.25, 18.123456789):
        store = SceneStore(tmp_path / f"{seconds}", "tiny")
        for place in ("evidence", "field/smoke/0"):
            with store.publish(place) as folder:
                (folder / "weights").write_bytes(b"the same")
                record = RECORD | {"seconds": seconds, "metadata": {"train_seconds": seconds}}
                (folder / RECORD_NAME).write_text(json.dumps(record))
                assert read_record(folder) == record
        with store.publish("novel_views/smoke/0") as folder:
            config = RunConfig(recipe=preset("smoke"))
            task = Task(scene=scene, store=store, config=config, folder=folder, progress=str)
            write_method(task, "test", method, {"frame": np.arange(2)}, {"sensor": ""}, np.eye(4))
            contents.append(content_of({"files": {".": file_checksums(folder, frozenset())}}))
        taken = read_arrays(store.path("novel_views/smoke/0/test") / f"{method}.zarr", "train_seconds")
        assert taken["train_seconds"] > seconds - 1.0
    assert contents[0] == contents[1]
