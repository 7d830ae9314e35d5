"""Laws of left-out images and of their variants."""

from dataclasses import replace

import torch

from nvsf_core.models.residual.left_out import LeftOut
from nvsf_core.rendering.camera_view import CameraView
from nvsf_core.rendering.plane_depth import plane_inverses
from nvsf_core.rendering.plane_volume import PlaneVolume, plane_volume
from nvsf_core.rendering.warping import plane_rays
from tests.models.residual.test_camera_step import RECIPE, example


def _volume(view: CameraView) -> PlaneVolume:
    inverses = plane_inverses(RECIPE.camera)[:, None, None]
    return plane_volume(view.sources(view.images.full), plane_rays(view.pinhole), view.pinhole, inverses)


def _off_centre() -> LeftOut:
    """An example whose camera looks aside and whose sources lie anywhere: a mirror shows another scene."""
    one = example()
    motion = one.view.motion.clone()
    motion[:, :3, 3] += torch.tensor([0.1, 0.05, -0.2])
    return replace(one, view=replace(one.view, pinhole=replace(one.view.pinhole, cx=28.0), motion=motion))


def test_a_mirror_shows_on_every_plane_what_the_view_shows_with_left_and_right_exchanged() -> None:
    one = _off_centre()
    there, mirrored = _volume(one.view), _volume(one.mirrored().view)
    assert not torch.allclose(there.colour, there.colour.flip(-1), atol=0.05)
    assert torch.allclose(mirrored.colour, there.colour.flip(-1), atol=2e-4)
    assert (mirrored.seen == there.seen.flip(-1)).float().mean() > 0.99


def test_a_mirror_of_a_mirror_is_the_example() -> None:
    one = _off_centre()
    again = one.mirrored().mirrored()
    assert again.view.pinhole == one.view.pinhole
    assert torch.equal(again.view.motion, one.view.motion)
    assert torch.equal(again.view.images.full, one.view.images.full)
    assert torch.equal(again.truth, one.truth)


def test_a_variant_changes_sources_and_truth_alike() -> None:
    one = example()
    # As if every source stood where the image was taken.
    same = torch.cat([one.truth.float() / 255.0, torch.ones(2, *one.truth.shape[1:])])
    images = replace(one.view.images, full=same.expand(3, -1, -1, -1))
    one = replace(one, view=replace(one.view, images=images))
    looks = set()
    for seed in range(8):
        variant = one.varied(torch.Generator().manual_seed(seed))
        shown = variant.view.images.full
        assert torch.allclose(shown[0, :3] * 255.0, variant.truth.float(), atol=0.51)
        assert torch.equal(shown[:, 3], torch.ones_like(shown[:, 3]))
        assert variant.truth.shape == one.truth.shape and variant.truth.dtype == torch.uint8
        looks.add(variant.truth.numpy().tobytes())
    assert len(looks) == 8


def test_variants_follow_from_the_generator_and_leave_the_example_alone() -> None:
    one = example()
    before = one.view.images.full.clone(), one.truth.clone()
    first, second = (one.varied(torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first.truth, second.truth)
    assert torch.equal(first.view.images.small, second.view.images.small)
    assert torch.equal(one.view.images.full, before[0]) and torch.equal(one.truth, before[1])
