"""Laws of the depth network."""

import torch
from torch.nn import functional

from nvsf_core.fields.depth_network import DepthNetwork
from nvsf_core.kernels.images.plane_features import N_FEATURES
from nvsf_core.recipe.residual import CameraSpec

SPEC = CameraSpec(sources=2)


def seeded(number: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(number)


def features(shape: tuple[int, int, int], seed: int) -> torch.Tensor:
    """Of (d, h, w) planes of pixels, as `plane_features` gives them: (d, N_FEATURES, h, w)."""
    return torch.rand(shape[0], N_FEATURES, *shape[1:], generator=seeded(seed))


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


def test_every_weight_learns() -> None:
    network = DepthNetwork(SPEC, seeded())
    with torch.no_grad():
        network.logit.weight.normal_(0.0, 0.05, generator=seeded(4))
    network(features((8, 12, 16), 1)).square().sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().sum() > 0, name
