"""Laws of variants of an example: the same scene, in other colours or in a mirror."""

from dataclasses import replace

import torch

from nvsf_core.fields.camera_networks import CameraNetworks
from nvsf_core.rendering.learned_warp import blend_sources
from nvsf_core.rendering.plane_depth import planes_of
from nvsf_core.rendering.variation import AS_RECORDED, Variation, random_variation
from tests.models.residual.test_camera_step import RECIPE, example

WINDOW = (slice(2, 12), slice(6, 26))


def _networks() -> CameraNetworks:
    """With weights that tell left from right."""
    networks = CameraNetworks(replace(RECIPE.camera, refinements=3), torch.Generator().manual_seed(0))
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for weight in networks.parameters():
            weight += 0.05 * torch.randn(weight.shape, generator=generator)
    return networks


def test_what_is_as_recorded_is_left_alone() -> None:
    image = torch.rand(3, 4, 5)
    assert AS_RECORDED.colours(image) is image and AS_RECORDED.turned(image) is image


def test_colours_are_permuted_and_scaled_and_never_above_white() -> None:
    image = torch.tensor([0.2, 0.5, 0.9])[:, None, None].expand(3, 2, 2)
    shown = Variation((2, 0, 1), 1.2).colours(image)
    torch.testing.assert_close(shown[:, 0, 0], torch.tensor([1.0, 0.24, 0.6]))


def test_a_mirror_of_a_mirror_is_the_image_and_networks_see_the_mirrored_one() -> None:
    mirror, image = Variation(is_mirrored=True), torch.rand(3, 4, 5)
    assert torch.equal(mirror.turned(mirror.turned(image)), image)
    assert torch.equal(mirror.turned(image)[..., 0], image[..., -1])
    networks, one = _networks(), example(itself=True)
    recorded, _ = planes_of(networks.depth, one.view, RECIPE.camera, WINDOW)
    mirrored, _ = planes_of(networks.depth, one.view, RECIPE.camera, WINDOW, mirror)
    assert not torch.allclose(recorded, mirrored, atol=1e-4)


def test_a_variant_of_a_view_has_its_truth_and_its_depths() -> None:
    """Untrained, networks show the wall in any variant: as its truth looks in the same variant."""
    spec = replace(RECIPE.camera, refinements=3)
    networks, one = CameraNetworks(spec, torch.Generator().manual_seed(0)), example()
    assert one.coarse is not None
    truth = one.truth.float() / 255.0
    recorded = blend_sources(networks, one.view, one.coarse, spec).hypotheses
    looks = set()
    for seed in range(6):
        shown_as = random_variation(torch.Generator().manual_seed(seed))
        blend = blend_sources(networks, one.view, one.coarse, spec, shown_as=shown_as)
        error = (blend.colour - shown_as.colours(truth)).abs()[:, 8:-8, 16:-16]
        assert error.median() < 0.05
        torch.testing.assert_close(blend.hypotheses.inverse, recorded.inverse)
        looks.add(shown_as)
    assert len(looks) == 6


def test_variants_follow_from_the_generator() -> None:
    first, second = (random_variation(torch.Generator().manual_seed(3)) for _ in range(2))
    assert first == second
