"""What moves with an object is part of it, and only that: a disc that passes a wall, known exactly."""

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.rendering import object_outlines
from nvsf_core.rendering.lidar_view import MovingPoints
from nvsf_core.rendering.object_outlines import ComparedImages, outlined

CAMERA = Pinhole(fx=80.0, fy=80.0, cx=63.5, cy=31.5, width=128, height=64)
DISC_M, WALL_M, RADIUS_M = 4.0, 8.0, 0.7
NUMBER = 3
COUNT, OWN = 7, 3
CAMERA_X_M = 0.1 * np.arange(COUNT)
DISC_X_M = CAMERA_X_M[OWN] + 0.4 * (np.arange(COUNT) - OWN)
POSES = np.tile(np.eye(4), (COUNT, 1, 1))
POSES[:, 0, 3] = CAMERA_X_M
RAYS = CAMERA.rays(CAMERA.pixels())
RAYS = RAYS / RAYS[..., 2:]


def texture(x: np.ndarray, y: np.ndarray, colours: tuple[float, ...]) -> np.ndarray:
    waves = np.sin(4.0 * x + 0.3) * np.cos(3.0 * y) + np.sin(2.0 * x + 4.0 * y)
    return np.stack([colour + 0.08 * waves for colour in colours], axis=-1)


def on_disc(number: int) -> np.ndarray:
    near = RAYS * DISC_M + POSES[number, :3, 3]
    return np.hypot(near[..., 0] - DISC_X_M[number], near[..., 1]) < RADIUS_M


def photographs(disc: tuple[float, ...] = (0.8, 0.6, 0.2)) -> torch.Tensor:
    """Images (j, 6, H, W) as sources; returns show that the upper half of the disc moves."""
    images = torch.zeros(COUNT, 6, 64, 128)
    for number in range(COUNT):
        near, far = (RAYS * depth_m + POSES[number, :3, 3] for depth_m in (DISC_M, WALL_M))
        moves = on_disc(number)
        own = texture(near[..., 0] - DISC_X_M[number], near[..., 1], disc)
        colours = np.where(moves[..., None], own, texture(far[..., 0], far[..., 1], (0.3, 0.4, 0.7)))
        images[number, :3] = torch.from_numpy(colours).permute(2, 0, 1)
        images[number, 3] = 1.0
        images[number, 5] = torch.from_numpy(moves & (RAYS[..., 1] < 0.0))
    return images


def moving(known: np.ndarray | None = None) -> MovingPoints:
    moved = np.tile(np.eye(4), (COUNT, 1, 1))
    moved[:, 0, 3] = DISC_X_M - DISC_X_M[OWN]
    if known is not None:
        moved[~known] = 0.0
    return MovingPoints(NUMBER, np.zeros((0, 3), np.float32), moved)


def upper_half() -> tuple[np.ndarray, np.ndarray]:
    """Inverse depths by which the lower half is part of the wall, and the disc's number on the upper half."""
    upper = on_disc(OWN) & (RAYS[..., 1] < 0.0)
    inverse = np.where(upper, 1.0 / DISC_M, 1.0 / WALL_M).astype(np.float32)
    return inverse, np.where(upper, NUMBER, 0).astype(np.int16)


def compared(images: torch.Tensor, others: list[int]) -> ComparedImages:
    return ComparedImages(images, POSES, CAMERA, OWN, others)


OTHERS = [number for number in range(COUNT) if number != OWN]


def test_the_half_without_returns_becomes_part_of_the_object_at_its_depth() -> None:
    inverse, mover = upper_half()
    depths, found = outlined(inverse, mover, [moving()], compared(photographs(), OTHERS))
    lower = on_disc(OWN) & (RAYS[..., 1] > 0.0)
    reach_px = 0.5 * CAMERA.fx / DISC_M
    near = lower & (RAYS[..., 1] * CAMERA.fy < reach_px - 1.0)
    assert (found[near] == NUMBER).mean() > 0.97
    assert (found[~on_disc(OWN)] == NUMBER).sum() < 0.05 * near.sum()
    np.testing.assert_allclose(depths[found == NUMBER], 1.0 / DISC_M, rtol=1e-6)
    np.testing.assert_array_equal(depths[found == 0], inverse[found == 0])
    assert (found[mover == NUMBER] == NUMBER).all()


def test_nothing_is_changed_where_nothing_moves_or_the_object_is_not_in_the_image() -> None:
    inverse, mover = upper_half()
    for there, numbers in (([], mover), ([moving()], np.zeros_like(mover))):
        depths, found = outlined(inverse, numbers, there, compared(photographs(), OTHERS))
        np.testing.assert_array_equal(depths, inverse)
        np.testing.assert_array_equal(found, numbers)


def test_a_background_that_only_looks_like_the_object_stays_static() -> None:
    # A smooth disc and wall of one colour: both explanations are as good, and the static one is simpler. So
    # the object loses its rim, too.
    images = torch.full((COUNT, 6, 64, 128), 0.5)
    images[:, 3], images[:, 4:] = 1.0, 0.0
    inverse, mover = upper_half()
    depths, found = outlined(inverse, mover, [moving()], compared(images, OTHERS))
    deep = distance_transform_edt(mover == NUMBER) > 6.0
    assert deep.any()
    static = mover == 0
    np.testing.assert_array_equal(found[static | deep], mover[static | deep])
    np.testing.assert_array_equal(depths[static | deep], inverse[static | deep])


def with_halo() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `upper_half`, but pixels around the disc count as its own, at its depth; and these, (H, W) bool."""
    inverse, mover = upper_half()
    halo = ~on_disc(OWN) & (RAYS[..., 1] < 0.0)
    middle = CAMERA.cx + CAMERA.fx * (DISC_X_M[OWN] - CAMERA_X_M[OWN]) / DISC_M
    columns, rows = np.meshgrid(np.arange(128), np.arange(64))
    halo &= np.hypot(columns - middle, rows - CAMERA.cy) < CAMERA.fx * RADIUS_M / DISC_M + 4.0
    inverse[halo], mover[halo] = 1.0 / DISC_M, NUMBER
    return inverse, mover, halo


def test_what_is_around_an_object_is_no_part_of_it() -> None:
    inverse, mover, halo = with_halo()
    depths, found = outlined(inverse, mover, [moving()], compared(photographs(), OTHERS))
    assert halo.sum() > 100
    assert (found[halo] == 0).all()
    np.testing.assert_allclose(depths[halo], 1.0 / WALL_M, rtol=1e-6)
    assert (found[(mover == NUMBER) & ~halo] == NUMBER).all()


def test_what_is_around_an_object_stays_with_it_where_no_other_image_shows_it_static() -> None:
    inverse, mover, _ = with_halo()
    images = photographs()
    images[:, 5] = 1.0  # all of each image may show what moves
    _, found = outlined(inverse, mover, [moving()], compared(images, OTHERS))
    assert (found[mover == NUMBER] == NUMBER).all()


def test_an_object_that_fills_the_image_keeps_all_of_it() -> None:
    inverse, everywhere = np.full((64, 128), 1.0 / DISC_M, np.float32), np.full((64, 128), NUMBER, np.int16)
    depths, found = outlined(inverse, everywhere, [moving()], compared(photographs(), OTHERS))
    np.testing.assert_array_equal(depths, inverse)
    np.testing.assert_array_equal(found, everywhere)


def test_what_moves_along_but_is_apart_from_the_object_is_not_part_of_it() -> None:
    images, patch = photographs(), np.zeros((64, 128), np.bool_)
    for number in range(COUNT):
        middle = round(CAMERA.cx + CAMERA.fx * (DISC_X_M[number] - CAMERA_X_M[number]) / DISC_M)
        images[number, :3, 23:28, middle - 20 : middle - 15] = torch.tensor([0.9, 0.1, 0.1])[:, None, None]
        if number == OWN:
            patch[23:28, middle - 20 : middle - 15] = True
    inverse, mover = upper_half()
    depths, found = outlined(inverse, mover, [moving()], compared(images, OTHERS))
    assert (found[patch] == 0).all()
    np.testing.assert_array_equal(depths[patch], inverse[patch])
    assert ((found == NUMBER) & (mover == 0)).any(), "what touches it is"


def test_what_others_contradict_is_the_objects_where_none_of_them_sees_the_object() -> None:
    # The object's place is known at the image's own instant only.
    inverse, mover = upper_half()
    alone = moving(np.arange(COUNT) == OWN)
    _, found = outlined(inverse, mover, [alone], compared(photographs(), OTHERS))
    lower = on_disc(OWN) & (RAYS[..., 1] > 0.0) & (RAYS[..., 1] * CAMERA.fy < 9.0)
    assert (found[lower] == NUMBER).mean() > 0.9
    # With no other image there is no reason to believe so.
    _, found = outlined(inverse, mover, [moving()], compared(photographs(), []))
    np.testing.assert_array_equal(found, mover)


def test_a_shadow_lies_on_what_it_falls_on() -> None:
    inverse, mover = upper_half()
    # The lower half is a shadow on something as near as the disc: it cannot lie behind that.
    below = RAYS[..., 1] > 0.0
    inverse[below] = 1.0 / (DISC_M - 0.2)
    depths, found = outlined(inverse, mover, [moving()], compared(photographs((0.9, 0.9, 0.1)), OTHERS))
    of_shadow = below & (found == NUMBER)
    assert of_shadow.any()
    np.testing.assert_allclose(depths[of_shadow], 1.01 / (DISC_M - 0.2), rtol=1e-6)


def test_the_input_arrays_are_left_as_they_were() -> None:
    inverse, mover = upper_half()
    outlined(inverse, mover, [moving()], compared(photographs(), OTHERS))
    again = upper_half()
    np.testing.assert_array_equal(inverse, again[0])
    np.testing.assert_array_equal(mover, again[1])


def test_the_part_around_an_object_shows_what_the_whole_image_does(monkeypatch) -> None:
    inverse, mover, _ = with_halo()
    given = (inverse, mover, [moving()], compared(photographs(), OTHERS))
    part = object_outlines._around(mover == NUMBER, inverse, CAMERA)
    assert mover[part].size < 0.75 * mover.size
    found = outlined(*given)
    monkeypatch.setattr(object_outlines, "_around", lambda *_: (slice(0, 64), slice(0, 128)))
    for one, expected in zip(found, outlined(*given), strict=True):
        np.testing.assert_array_equal(one, expected)
