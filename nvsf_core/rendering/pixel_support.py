"""Which pixels of a rendered image recorded images show, and from how far away."""

import torch
from torch import Tensor

from nvsf_core.rendering.camera_view import CameraView
from nvsf_core.rendering.sources import look_up
from nvsf_core.rendering.support import Support
from nvsf_core.rendering.warping import plane_rays

_MOST_ANGLE_RAD = 0.1
"""An image sees a point as the view does if it looks at it from a direction that differs by at most this,"""
_MOST_RATIO = 1.5
"""and from a distance that differs by at most this factor."""


@torch.no_grad()
def pixel_support(view: CameraView, inverse: Tensor) -> Tensor:
    """(H, W) uint8 class of `Support` of each pixel of a view.

    Seen is what an image shows from about the view's direction and distance, extrapolated what one shows from
    elsewhere, guessed what none of the view's sources shows, or where no image's depth map has a surface.

    Args:
        view: The view; its images have depths.
        inverse: (H, W) inverse depth of what is shown, 1/m.
    """
    assert view.surfaces is not None
    rays, sources = plane_rays(view.pinhole, view.device), view.sources(view.images.full)
    point = rays / inverse[..., None].clamp_min(1e-4)
    away_m = torch.linalg.vector_norm(point, dim=-1)
    support = torch.full_like(inverse, int(Support.GUESSED), dtype=torch.uint8)
    for number, motion in enumerate(view.motion):
        _, shown = look_up(sources, number, rays, inverse[None], view.pinhole, view.label)
        from_source = point + motion[:3, :3].T @ motion[:3, 3]
        other_m = torch.linalg.vector_norm(from_source, dim=-1)
        angle = torch.arccos(((point * from_source).sum(dim=-1) / (away_m * other_m)).clamp(-1.0, 1.0))
        ratio = torch.maximum(away_m / other_m, other_m / away_m)
        alike = (angle <= _MOST_ANGLE_RAD) & (ratio <= _MOST_RATIO)
        found = torch.where(alike, int(Support.SEEN), int(Support.EXTRAPOLATED)).to(torch.uint8)
        support = torch.where(shown[0], torch.maximum(support, found), support)
    has_surface = (view.surfaces.support[0] > 0.0) | (view.surfaces.label > 0)
    return torch.where(has_surface, support, int(Support.GUESSED))
