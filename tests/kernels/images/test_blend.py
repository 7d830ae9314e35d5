"""Colours are blended by their depths' probabilities, their sources' nearness and trust."""

import numpy as np

from nvsf_core.kernels.images import blend
from nvsf_core.kernels.images.blend import blended

SOURCES, DEPTHS, SHAPE = 2, 3, (7, 11)
RNG = np.random.default_rng(0)


def inputs() -> dict[str, np.ndarray]:
    """What two sources show at three depths."""
    return {
        "colour": RNG.random((SOURCES, 3, DEPTHS, *SHAPE), np.float32),
        "seen": RNG.random((SOURCES, DEPTHS, *SHAPE)) < 0.7,
        "share": RNG.random((DEPTHS, *SHAPE), np.float32),
        "nearness": np.array([1.0, 0.5], np.float32),
        "around": RNG.random((3, *SHAPE), np.float32),
        "trust": RNG.random((DEPTHS * SOURCES + 1, *SHAPE), np.float32),
    }


def test_the_kernel_takes_the_weighted_mean() -> None:
    given = inputs()
    weight = (given["share"] + blend._OFFSET[:, None, None])[:, None] * (
        given["nearness"][None, :, None, None] ** blend._NEARNESS_POWER
    )
    weight = weight * given["trust"][:-1].reshape(weight.shape) * given["seen"].swapaxes(0, 1)
    beside = blend._AROUND * given["nearness"][1] * given["trust"][-1]
    colour = given["colour"].transpose(2, 0, 1, 3, 4)
    whole = (weight[:, :, None] * colour).sum(axis=(0, 1)) + beside * given["around"]
    np.testing.assert_allclose(blended(**given), whole / (weight.sum(axis=(0, 1)) + beside), rtol=1e-5)


def test_what_a_source_does_not_show_may_have_any_colour() -> None:
    given = inputs()
    first = blended(**given)
    hidden = np.broadcast_to(~given["seen"][:, None], given["colour"].shape)
    given["colour"][hidden] = np.nan
    assert np.array_equal(blended(**given), first)


def test_where_nothing_is_seen_the_colour_around_stays() -> None:
    given = inputs()
    given["seen"][:] = False
    np.testing.assert_allclose(blended(**given), given["around"], rtol=1e-5)


def test_at_the_place_of_a_recorded_image_its_own_colour_is_hardly_blurred() -> None:
    given = inputs()
    given["seen"][:], given["trust"][:], given["share"][0] = True, 1.0, 1.0
    given["colour"][0] = given["colour"][0, :, :1]
    given["nearness"][1] = 0.01
    apart = np.abs(blended(**given) - given["colour"][0, :, 0])
    given["nearness"][1] = 1.0
    assert apart.max() < 0.02 < np.abs(blended(**given) - given["colour"][0, :, 0]).mean()


def test_a_source_without_nearness_is_a_placeholder() -> None:
    given = inputs()
    given["nearness"][1] = 0.0
    first = blended(**given)
    given["colour"][1] = 1.0 - given["colour"][1]
    np.testing.assert_allclose(blended(**given), first, rtol=1e-5)


def test_of_a_sharp_view_nearly_all_is_from_the_source_that_is_trusted_most() -> None:
    given = inputs()
    given["seen"][:], given["trust"][:], given["share"][:] = True, 1.0, 0.0
    given["share"][0] = 1.0
    apart = [np.abs(blended(**given, sharpness=s) - given["colour"][0, :, 0]).mean() for s in (0.0, 0.5, 1.0)]
    assert apart[2] < 0.2 * apart[0] and apart[2] < apart[1] < apart[0]
