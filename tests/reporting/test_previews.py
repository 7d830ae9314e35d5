"""Previews are small PNGs that show what is there."""

import io

import numpy as np
from PIL import Image

from nvsf_core.reporting import previews


def _open(content: bytes) -> np.ndarray:
    assert len(content) < previews.MAX_BYTES
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


def test_noise_still_fits_in_an_event_log() -> None:
    generator = np.random.default_rng(0)
    _open(previews.range_preview(generator.uniform(0.0, 80.0, (66, 1030))))
    _open(previews.range_preview(generator.uniform(0.0, 80.0, (128, 4000))))
    _open(previews.scan_top_view(generator.normal(0.0, 20.0, (120_000, 3))))
    _open(previews.image_preview(generator.integers(0, 255, (376, 1408, 3), np.uint8)))


def test_a_ray_without_return_is_black() -> None:
    range_m = np.full((4, 8), 10.0)
    range_m[0, :3] = [0.0, np.nan, np.inf]
    picture = _open(previews.range_preview(range_m))
    assert (picture[0, :3] == 0).all()
    assert (picture[0, 3:].sum(axis=1) > 0).all()


def test_each_support_has_a_colour_that_is_dark_without_a_return() -> None:
    support, returned = np.tile(np.arange(3), (2, 1)), np.array([[True] * 3, [False] * 3])
    picture = _open(previews.support_preview(support, returned, row_repeat=1)).astype(int)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 6
    assert (picture[0].sum(axis=1) > 2.5 * picture[1].sum(axis=1)).all()


def test_from_above_forward_is_up_and_left_is_left() -> None:
    points_m = np.array([[39.0, 0.0, 0.0], [0.0, 39.0, 0.0]])
    levels = previews.top_view_levels(points_m, np.array([7, 9]), 40.0, 80)
    assert np.argwhere(levels).tolist() == [[1, 40], [40, 1]] and levels.max() == 9


def test_the_path_shows_each_split_and_what_cannot_be_used_in_its_own_way() -> None:
    path_m = np.column_stack([np.arange(200.0), 5.0 * np.sin(np.arange(200) / 30.0)])

    def picture(splits: list[str], uses: list[str]) -> np.ndarray:
        return _open(previews.path_preview(path_m, list(range(200)), splits, uses))

    plain = picture(["train"] * 200, ["whole"] * 200)
    held_out = picture(["train"] * 199 + ["test"], ["whole"] * 200)
    unusable = picture(["train"] * 199 + ["test"], ["whole"] * 199 + ["none"])
    orange = np.array([0xD9, 0x82, 0x2B])
    assert not (plain == orange).all(axis=2).any()
    assert 0 < (unusable == orange).all(axis=2).sum() < (held_out == orange).all(axis=2).sum()
    _open(previews.path_preview(path_m[:1], [0], ["train"], ["part"]))
