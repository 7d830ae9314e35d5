"""Images of a bag that no scan takes are counted, camera by camera."""

from pathlib import Path

from nvsf_core.drives.detect import whole_drive
from nvsf_core.stages.imports.convert import import_drive
from tests.drives.bags.small_bag import HEIGHT, WIDTH, camera, moving_lidar, write_bag

LENS = (60.0, 60.0, WIDTH / 2, HEIGHT / 2)


def _notes(folder: Path, times_s: list[float]) -> list[str]:
    """Notes on images of an import of four scans at 10 Hz, from 1 s on, and images of these times."""
    messages = moving_lidar()
    for time_s in times_s:
        info, image = camera(time_s, LENS, [0.0] * 5, LENS)
        messages += [("/cam/camera_info", info, time_s), ("/cam/image_raw", image, time_s)]
    write_bag(folder / "bag", messages)
    done = import_drive(whole_drive(folder / "bag", "bag"), folder / "out", progress=str)
    return [note for note in done.notes if "images" in note]


def test_images_of_no_scan_of_their_own_are_counted(tmp_path: Path) -> None:
    (note,) = _notes(tmp_path, [1.0 + k / 30.0 for k in range(10)])
    assert note.startswith("cam: 6 of 10 images in the bag are left out")


def test_where_each_image_has_a_scan_nothing_is_said(tmp_path: Path) -> None:
    assert _notes(tmp_path, [1.01, 1.11, 1.31]) == []
