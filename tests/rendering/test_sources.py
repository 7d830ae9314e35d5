"""Sources of a view: kernels and torch's operations give the same colours and agreement."""

import numpy as np
import pytest
import torch

from nvsf_core.errors import DivergedError
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.kernels.images.source_lookup import least_differences
from nvsf_core.rendering import plane_volume
from nvsf_core.rendering.plane_volume import Agreement, agreement
from nvsf_core.rendering.sources import SeenPoints, Sources, kernel_inputs, look_up, look_up_by_torch
from nvsf_core.rendering.warping import plane_rays

CAMERA = Pinhole(fx=40.0, fy=41.0, cx=23.0, cy=16.0, width=48, height=32)
DEPTHS = 5


def scene(channels: int, *, label: bool) -> tuple[Sources, SeenPoints]:
    """Smooth random images, hidden parts, a placeholder source, and, with labels, something that moves."""
    g = torch.Generator().manual_seed(3)
    images = torch.nn.functional.interpolate(
        torch.rand(4, channels, 8, 12, generator=g), (32, 48), mode="bilinear", align_corners=False
    )
    images[:, 3] = 1.0
    images[:, 3, :4, :6] = 0.0
    images[:, 4] *= 0.2
    motion = torch.eye(4).repeat(3, 1, 1)
    motion[:, :3, 3] = 0.4 * torch.randn(3, 3, generator=g)
    moved = motion.clone()[None]
    moved[0, :, 0, 3] += 0.5
    moved[0, 1] = 0.0
    where = torch.zeros(32, 48, dtype=torch.uint8)
    where[10:20, 12:30] = 1
    points = SeenPoints(
        plane_rays(CAMERA), 0.02 + 0.2 * torch.rand(DEPTHS, 32, 48, generator=g), where if label else None
    )
    nearness = torch.tensor([1.0, 0.5, 0.0])
    return Sources(images, [3, 0, 1], motion, nearness, moved if label else None), points


@pytest.mark.parametrize(("channels", "label"), [(5, False), (6, True)])
def test_the_kernel_sees_what_torch_sees(channels: int, label: bool) -> None:
    sources, points = scene(channels, label=label)
    ours, seen = look_up(sources, points, CAMERA)
    theirs, also = look_up_by_torch(sources, points, CAMERA)
    # At a threshold the last bit may decide.
    assert (seen == also).float().mean() > 0.999 and 0.1 < seen.float().mean() < 0.9
    assert not seen[2].any()
    both = (seen & also)[:, None].expand_as(ours)
    # Torch's colours are bilinear: of these smooth images they differ little.
    apart = (ours - theirs)[both].abs()
    assert apart.median() < 0.01 < apart.max() < 0.1


@pytest.mark.parametrize("first", [0, 1])
def test_sources_agree_as_torch_says(first: int) -> None:
    sources, points = scene(6, label=True)
    weight = torch.tensor([1.0, 1.0, 0.3] if first == 0 else [0.0, 1.0, 1.0])
    ours = agreement(sources, points, CAMERA, first)
    theirs = plane_volume._agreement(*look_up_by_torch(sources, points, CAMERA), weight)
    for name in Agreement._fields:
        apart = (getattr(ours, name) - getattr(theirs, name)).abs()
        assert (apart > 1e-4).float().mean() < 2e-3, name


def test_a_depth_that_is_not_finite_is_refused() -> None:
    sources, points = scene(5, label=False)
    points.inverse[0, 3, 4] = torch.nan
    with pytest.raises(DivergedError, match="inverse depths"):
        look_up(sources, points, CAMERA)


def test_an_image_shows_of_a_moving_object_what_it_does_not_hide_itself() -> None:
    """An object 5 m ahead; on the right the image itself shows a surface 4 m ahead."""
    images = torch.rand(1, 6, 32, 48, generator=torch.Generator().manual_seed(0))
    images[:, 3], images[:, 4], images[:, 5] = 1.0, 0.2, 1.0
    images[:, 4, :, 24:] = 0.25
    still = torch.eye(4)[None]
    sources = Sources(images, [0], still, torch.ones(1), still[None])
    points = SeenPoints(
        plane_rays(CAMERA), torch.full((1, 32, 48), 0.2), torch.ones(32, 48, dtype=torch.uint8)
    )
    by_torch = look_up_by_torch(sources, points, CAMERA)
    for _, seen in (look_up(sources, points, CAMERA), by_torch):
        shown = seen.reshape(32, 48)
        assert shown[:, :23].all() and not shown[:, 25:].any()


def test_the_half_of_the_sources_that_differ_least_counts() -> None:
    sources, points = scene(6, label=False)
    own = np.ascontiguousarray(sources.images[3].permute(1, 2, 0).numpy())
    inverse = points.inverse.clone()
    inverse[:, :, 40:], inverse[1, 0, :40] = inverse[:1, :, 40:], 0.0
    points = SeenPoints(points.rays, inverse, torch.zeros(32, 48, dtype=torch.uint8))
    others = Sources(sources.images, sources.chosen[1:], sources.motion[1:], sources.nearness[1:])
    found = torch.from_numpy(least_differences(kernel_inputs(others, points, CAMERA), own, 0.2))
    colour, seen = look_up_by_torch(sources, points, CAMERA)
    apart = (colour[1] - sources.images[3, :3, None]).abs().mean(dim=0).clamp_max(0.2)
    # The third source is a placeholder: what is left is the second.
    expected = torch.where(seen[1] & (inverse > 0.0), apart, 0.2)
    assert ((found - expected)[:, :, :40].abs() > 1e-4).float().mean() < 2e-3
    assert (found[:, :, 40:] == 0.0).all(), "there is nothing to compare"
