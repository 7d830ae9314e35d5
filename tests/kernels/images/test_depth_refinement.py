"""Which surface a pixel shows, and which depths other maps confirm."""

import numpy as np

from nvsf_core.kernels.images.depth_refinement import confirmed, likeliest_surface

SHAPE = (24, 40)
NEAR, FAR = np.float32(0.2), np.float32(0.05)
FX = 40.0


def halves(left: float, right: float) -> np.ndarray:
    image = np.full((*SHAPE, 3), left, np.float32)
    image[:, 20:] = right
    return image


def test_the_edge_between_surfaces_is_that_of_the_image() -> None:
    image, noise = halves(0.2, 0.8), np.random.default_rng(0).uniform(0.0, 0.02, (2, *SHAPE))
    # The depth map has the near surface 3 px too wide; single pixels say little, their surroundings more.
    layers = np.stack([np.full(SHAPE, NEAR), np.full(SHAPE, NEAR)])
    layers[0, :, 23:], layers[1, :, 17:] = FAR, FAR
    difference = noise.astype(np.float32)
    difference[0, :, 20:23] += 0.03
    difference[1, :, 17:20] += 0.03
    found = likeliest_surface(image, layers, difference)
    np.testing.assert_array_equal(found, np.where(image[..., 0] < 0.5, NEAR, FAR))


def test_what_looks_the_same_at_both_depths_is_far() -> None:
    layers = np.stack([np.full(SHAPE, NEAR), np.full(SHAPE, FAR)])
    found = likeliest_surface(halves(0.5, 0.5), layers, np.full(layers.shape, 0.01, np.float32))
    assert (found == FAR).all()


def test_unknown_depths_are_not_chosen() -> None:
    layers = np.stack([np.full(SHAPE, NEAR), np.zeros(SHAPE, np.float32)])
    difference = np.stack([np.full(SHAPE, 0.06), np.zeros(SHAPE)]).astype(np.float32)
    assert (likeliest_surface(halves(0.5, 0.5), layers, difference) == NEAR).all()


def to_image(right_m: float) -> np.ndarray:
    """(3, 4) from points (u, v, 1, q) of an image to pixels times z of one that stands to its right."""
    motion = np.eye(3, 4, dtype=np.float32)
    motion[0, 3] = -FX * right_m
    return motion


def test_a_depth_that_no_other_map_has_is_marked_and_one_that_one_has_stays() -> None:
    own = np.full(SHAPE, FAR)
    own[8:12, 26:30] = NEAR
    others = np.full((2, *SHAPE), FAR)
    motions = np.stack([to_image(1.0), to_image(-1.0)])
    static = np.ones(SHAPE, np.bool_)
    found = confirmed(own, motions, others, static)
    np.testing.assert_array_equal(found, np.where(own == NEAR, -own, own))
    # The near square stands 8 px farther left in the first other image.
    others[0, 8:12, 18:22] = NEAR
    np.testing.assert_array_equal(confirmed(own, motions, others, static), own)


def test_where_no_other_map_knows_anything_a_depth_stays_and_what_moves_is_not_asked() -> None:
    own = np.full(SHAPE, NEAR)
    nothing = np.zeros((1, *SHAPE), np.float32)
    static = np.ones(SHAPE, np.bool_)
    np.testing.assert_array_equal(confirmed(own, to_image(1.0)[None], nothing, static), own)
    static[:, 20:] = False
    other = np.full((1, *SHAPE), FAR)
    found = confirmed(own, to_image(1.0)[None], other, static)
    assert (found[:, 20:] == NEAR).all()
    # 8 px beyond the border no map is asked.
    assert (found[:, 8:20] == -NEAR).all()
    assert (found[:, :8] == NEAR).all()


def test_where_in_its_row_a_pixel_lies_makes_no_difference() -> None:
    # Pixels are averaged many at a time; of a wide image the same part lies elsewhere among them.
    g = np.random.default_rng(3)
    image, difference = g.random((20, 300, 3), np.float32), g.random((2, 20, 300), np.float32) * 0.06
    layers = np.stack([np.full((20, 300), NEAR), np.where(g.random((20, 300)) < 0.3, FAR, NEAR)])
    difference[1] = np.where(layers[1] == NEAR, difference[0], difference[1])
    whole = likeliest_surface(image, layers, difference)
    part = likeliest_surface(
        *(one.copy() for one in (image[:, 50:], layers[:, :, 50:], difference[:, :, 50:]))
    )
    assert 0.02 < (whole == FAR).mean() < 0.3
    # Beyond the border nothing is averaged.
    np.testing.assert_array_equal(part[:, 6:], whole[:, 56:])
