"""Laws of the camera's networks."""

import torch
from torch.nn import functional

from nvsf_core.fields.camera_networks import (
    HYPOTHESES,
    VOLUME_FEATURES,
    BlendInput,
    BlendNetwork,
    DepthNetwork,
)
from nvsf_core.recipe import CameraSpec

SPEC = CameraSpec(sources=2)
SHAPE = (21, 34)


def seeded(number: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(number)


def inputs() -> dict[str, torch.Tensor]:
    """What two sources show at three depths."""
    looked_up = HYPOTHESES * SPEC.sources
    return {
        "colour": torch.rand(looked_up, 3, *SHAPE, generator=seeded(1)),
        "seen": torch.ones(looked_up, *SHAPE, dtype=torch.bool),
        "share": torch.rand(HYPOTHESES, *SHAPE, generator=seeded(2)),
        "coarse": torch.rand(3, *SHAPE, generator=seeded(3)),
        "nearness": torch.tensor([1.0, 0.5]),
        "trust": torch.ones(looked_up + 1, *SHAPE),
    }


def features(shape: tuple[int, int, int], seed: int) -> torch.Tensor:
    """Of (d, h, w) planes of pixels, as `plane_features` gives them: (d, VOLUME_FEATURES, h, w)."""
    return torch.rand(shape[0], VOLUME_FEATURES, *shape[1:], generator=seeded(seed))


def test_depth_logits_have_the_shape_of_the_planes_whatever_the_window() -> None:
    network = DepthNetwork(SPEC, seeded())
    for shape in ((48, 12, 17), (7, 5, 5)):
        assert network(features(shape, 1)).shape == shape


def test_depths_are_compared_as_by_3d_convolutions() -> None:
    network = DepthNetwork(SPEC, seeded())
    for shape in ((7, 6, 9), (8, 5, 4)):
        given = features(shape, 2)
        with torch.no_grad():
            network.logit.weight.normal_(0.0, 0.05, generator=seeded(4))
        volume = given.transpose(0, 1)[None]

        def raised(x: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
            return functional.interpolate(x, like.shape[2:], mode="nearest")

        wide = network.down(volume).relu()
        deep = network.deepest(network.deep(wide).relu()).relu()
        wide = network.join(wide + raised(network.raise_deep(deep), wide)).relu()
        full = (network.near(volume) + raised(network.raise_join(wide), volume)).relu()
        logits = (network.logit(full) + network.prior(volume))[0, 0]
        torch.testing.assert_close(network(given), logits, atol=1e-5, rtol=1e-5)


def test_an_untrained_blend_lies_between_the_colours_that_it_blends() -> None:
    given = inputs()
    blended = BlendNetwork(SPEC, seeded())(BlendInput.of(**given))
    offered = torch.cat([given["colour"], given["coarse"][None]])
    assert blended.shape == (3, *SHAPE)
    assert (blended >= offered.amin(dim=0) - 1e-5).all()
    assert (blended <= offered.amax(dim=0) + 1e-5).all()


def test_a_source_that_does_not_show_a_pixel_has_no_say() -> None:
    network, given = BlendNetwork(SPEC, seeded()), inputs()
    with torch.no_grad():
        network.out.weight.normal_(0.0, 0.05, generator=seeded(4))
    given["seen"][1] = False
    first = network(BlendInput.of(**given))
    given["colour"][1] = 1.0 - given["colour"][1]
    torch.testing.assert_close(network(BlendInput.of(**given)), first, atol=1e-5, rtol=0.0)


def test_without_trust_a_source_has_hardly_a_say_before_training() -> None:
    network, given = BlendNetwork(SPEC, seeded()), inputs()
    given["trust"][1::2] = 0.0
    first = network(BlendInput.of(**given))
    given["colour"][1::2] = 1.0 - given["colour"][1::2]
    torch.testing.assert_close(network(BlendInput.of(**given)), first, atol=1e-3, rtol=0.0)


def test_where_nothing_is_seen_the_coarse_colour_stays() -> None:
    given = inputs()
    given["seen"][:] = False
    torch.testing.assert_close(BlendNetwork(SPEC, seeded())(BlendInput.of(**given)), given["coarse"])


def test_every_weight_of_both_networks_learns() -> None:
    blend, depth = BlendNetwork(SPEC, seeded()), DepthNetwork(SPEC, seeded())
    with torch.no_grad():
        blend.out.weight.normal_(0.0, 0.05, generator=seeded(4))
        depth.logit.weight.normal_(0.0, 0.05, generator=seeded(4))
    blend(BlendInput.of(**inputs())).square().sum().backward()
    depth(features((8, 12, 16), 1)).square().sum().backward()
    for network in (blend, depth):
        for name, parameter in network.named_parameters():
            assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
            assert parameter.grad.abs().sum() > 0, name
