"""True images of a view, named by a catalogue: found, or refused with what was expected and where."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from nvsf_core.drives.catalogue import SceneEntry, ViewEntry, load_catalogue
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.view_truth import require_truth, truth_files
from nvsf_core.errors import DataError

REPOSITORY = Path(__file__).resolve().parents[2]
VIEW = ViewEntry(name="right", frames=(3, 5), truth=(("image_00", Path("right")),))


def _image(path: Path, width: int = 8) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.zeros((6, width, 3), np.uint8))
    return path


@pytest.fixture
def scene(tmp_path: Path) -> SceneEntry:
    """A drive with one recorded image, and true images of its frames 3 and 5."""
    entry = SceneEntry(
        name="a", root=tmp_path, sequence="s_sync", first_frame=3, last_frame=6, test_frames=(4,),
        views=(VIEW,),
    )  # fmt: skip
    _image(DriveLayout(tmp_path, "s_sync").image_path("image_00", 4))
    for frame in (3, 5):
        _image(tmp_path / "right" / f"{frame:010d}.png")
    return entry


def test_true_images_are_found_by_their_frames_below_the_root(scene: SceneEntry) -> None:
    require_truth(scene)
    found = truth_files(scene, VIEW)
    assert {frame: path.name for frame, path in found["image_00"].items()} == {
        3: "0000000003.png", 5: "0000000005.png",
    }  # fmt: skip
    assert found["image_00"][3].parent == scene.root / "right"


def test_a_view_of_all_frames_is_compared_where_there_is_an_image(scene: SceneEntry) -> None:
    assert set(truth_files(scene, replace(VIEW, frames="all"))["image_00"]) == {3, 5}


def _no_folder(scene: SceneEntry) -> None:
    (scene.root / "right").rename(scene.root / "left")


def _no_image(scene: SceneEntry) -> None:
    (scene.root / "right" / "0000000005.png").unlink()


def _larger(scene: SceneEntry) -> None:
    _image(scene.root / "right" / "0000000005.png", width=9)


def _no_png(scene: SceneEntry) -> None:
    (scene.root / "right" / "0000000005.png").write_text("none")


def _no_camera(scene: SceneEntry) -> None:
    DriveLayout(scene.root, "s_sync").image_path("image_00", 4).unlink()
    scan = DriveLayout(scene.root, "s_sync").scan_path(4)
    scan.parent.mkdir(parents=True)
    scan.touch()


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (_no_folder, "expected a folder of images at .*right, found none; correct `truth`"),
        (_no_image, r"expected images of frames \[5\] in .*right, found none, as 0000000005.png"),
        (_larger, "expected 8 x 6 pixels as in 0000000004.png, found 9 x 6 in .*0000000005.png"),
        (_no_png, "expected 8 x 6 pixels .*, found no PNG in .*0000000005.png"),
        (_no_camera, "expected recorded images of that camera in .*image_00.*, found none"),
    ],
)
def test_what_is_wrong_with_true_images_is_said_before_training(scene: SceneEntry, harm, words: str) -> None:
    harm(scene)
    with pytest.raises(DataError, match=f"scene a, view right: truth of image_00: {words}"):
        require_truth(scene)


def test_a_scene_without_data_is_not_blamed_for_its_truth(scene: SceneEntry) -> None:
    require_truth(replace(scene, root=scene.root / "nowhere"))


def test_the_right_camera_is_the_truth_of_a_view_of_the_shared_drive() -> None:
    shared = REPOSITORY.parent / "shared/data/scenes.toml"
    if not shared.is_file():
        pytest.skip("no shared drives beside the checkout")
    catalogue = load_catalogue([shared, REPOSITORY / "benchmarks/real_views.toml"], None)
    scene = next(entry for entry in catalogue if entry.name == "kitti0005_van_cyclist")
    (view,) = scene.views
    require_truth(scene)
    assert set(truth_files(scene, view)["image_00"]) == set(view.frames) > {13, 20, 27, 34}
