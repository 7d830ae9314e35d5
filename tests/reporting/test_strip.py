"""A view's animation has recorded and synthetic pictures of each instant beside each other."""

import io
from pathlib import Path

import numpy as np
from PIL import Image

from nvsf_core.reporting.strip import MOST_STEPS, strip_of
from nvsf_core.stores.arrays import write_arrays

_RECORDED, _SYNTHETIC = (200, 60, 40), (40, 90, 200)


def _images(colour: tuple[int, int, int], count: int) -> np.ndarray:
    """Images whose brightness grows with time."""
    shade = np.linspace(0.5, 1.0, count)[:, None, None, None]
    return np.broadcast_to(shade * np.array(colour), (count, 40, 100, 3)).astype(np.uint8)


def _write(root: Path, count: int, cameras: list[str], *, has_scans: bool = True) -> Path:
    frames, view = np.arange(10, 10 + count), root / "novel_views/quick/0/left"
    pano = np.full((count, 66, 1030), 10.0, np.float32)
    write_arrays(
        view / "model.zarr",
        {"frame": frames, "image_00_rgb": _images(_SYNTHETIC, count), "image_00_frame": frames}
        | ({"pano_range_m": pano} if has_scans else {}),
        {"cameras": cameras, "sensor": "HDL-64E" if has_scans else ""},
    )  # fmt: skip
    known = {"image_00_rgb": _images(_RECORDED, count), "image_00_frame": frames}
    write_arrays(root / "undistorted/images.zarr", known)
    write_arrays(root / "pano/pano.zarr", {"frame": frames, "linear_range_m": pano})
    return view


def _frames(strip: bytes | None) -> list[np.ndarray]:
    assert strip is not None
    picture = Image.open(io.BytesIO(strip))
    assert picture.format == "WEBP"
    found = []
    for number in range(picture.n_frames):
        picture.seek(number)
        found.append(np.asarray(picture.convert("RGB")).astype(int))
    return found


def test_each_instant_has_the_recorded_image_left_and_the_synthetic_right(tmp_path: Path) -> None:
    frames = _frames(strip_of(tmp_path, _write(tmp_path, 3, ["image_00"])))
    assert len(frames) == 3
    for frame, shade in zip(frames, (0.5, 0.75, 1.0), strict=True):
        for column, colour in ((200, _RECORDED), (700, _SYNTHETIC)):
            assert np.abs(frame[100, column] - shade * np.array(colour)).max() < 12
    with_ranges, without = frames[0].shape[0], _write(tmp_path / "b", 3, ["image_00"], has_scans=False)
    assert _frames(strip_of(tmp_path / "b", without))[0].shape[0] < with_ranges


def test_a_long_view_is_shown_in_few_steps_and_a_single_instant_not_at_all(tmp_path: Path) -> None:
    assert len(_frames(strip_of(tmp_path, _write(tmp_path, 40, ["image_00"], has_scans=False)))) == MOST_STEPS
    assert strip_of(tmp_path / "one", _write(tmp_path / "one", 1, ["image_00"])) is None
    assert strip_of(tmp_path / "no", _write(tmp_path / "no", 3, [], has_scans=False)) is None


def test_instants_that_share_a_frame_have_their_own_synthetic_images(tmp_path: Path) -> None:
    view = _write(tmp_path, 4, ["image_00"], has_scans=False)
    shared = np.array([10, 10, 11, 11])
    synthetic = {"frame": shared, "image_00_rgb": _images(_SYNTHETIC, 4), "image_00_frame": shared}
    write_arrays(view / "model.zarr", synthetic, {"cameras": ["image_00"], "sensor": ""})
    brightness = [frame[100, 700].sum() for frame in _frames(strip_of(tmp_path, view))]
    assert brightness == sorted(set(brightness)) and len(brightness) == 4
