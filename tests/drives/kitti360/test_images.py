from pathlib import Path

import cv2
import numpy as np
import pytest

from nvsf_core.drives.kitti360.images import decode_picture, read_image
from nvsf_core.errors import DataError


def picture() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)


def written(path: Path, rgb: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), rgb[..., ::-1])
    return path


def test_an_image_comes_back_bit_for_bit_red_first(tmp_path: Path) -> None:
    rgb = picture()
    assert np.array_equal(read_image(written(tmp_path / "a.png", rgb), 64, 48), rgb)


def test_another_size_than_the_calibration_says_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"wrong size, expected 48 x 64 .* found 64 x 48"):
        read_image(written(tmp_path / "a.png", picture()), 48, 64)


@pytest.mark.parametrize("kept", [0, 5, 100, 6000, -1])
def test_an_image_cut_anywhere_is_refused(tmp_path: Path, kept: int) -> None:
    path = written(tmp_path / "a.png", picture())
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(DataError, match="unreadable image"):
        read_image(path, 64, 48)


def test_a_flipped_bit_is_noticed(tmp_path: Path) -> None:
    path = written(tmp_path / "a.png", picture())
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(DataError, match="checksum of chunk 'IDAT' is wrong"):
        read_image(path, 64, 48)


def test_an_absent_image_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no image file .*a\.png"):
        read_image(tmp_path / "a.png", 64, 48)


@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpeg_says_its_size_before_it_is_decoded(tmp_path: Path, progressive: int) -> None:
    packed, data = cv2.imencode(".jpg", picture(), [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])
    assert packed and decode_picture(tmp_path, data.tobytes(), 64, 48).shape == (48, 64, 3)
    with pytest.raises(DataError, match=r"wrong size, expected 32 x 48 .* found 64 x 48"):
        decode_picture(tmp_path, data.tobytes(), 32, 48)
    frame = data.tobytes().index(b"\xff\xc2" if progressive else b"\xff\xc0")
    with pytest.raises(DataError, match=r"wrong size, expected 64 x 48 .* found none"):
        decode_picture(tmp_path, data.tobytes()[:frame] + b"\xff\xd9", 64, 48)
