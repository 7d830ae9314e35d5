"""Depth maps of the training images: what each image shows, compared with the images around it."""

import numpy as np
import torch

from nvsf_core.fields.depth_network import DepthNetwork
from nvsf_core.geometry.se3 import invert_pose, transform_points
from nvsf_core.kernels.images.depth_splat import without_edges
from nvsf_core.kernels.threads import images_at_once, in_parts
from nvsf_core.models.residual.camera_examples import ShownCamera
from nvsf_core.rendering.camera_view import camera_view
from nvsf_core.rendering.lidar_view import MovingPoints, lidar_view
from nvsf_core.rendering.object_outlines import ComparedImages, outlined
from nvsf_core.rendering.plane_depth import image_inverse_depth
from nvsf_core.rendering.sharp_depths import ASKED, COMPARED, agreed, sharpened, static_sources
from nvsf_core.rendering.view_depth_maps import DepthMaps, baseline_sources

_UNKNOWN = np.float32(0.0)
_MARGIN_M = 0.3
"""Pixels of a moving object are nearer or farther than all its returns by at most so much."""


def image_depths(network: DepthNetwork, camera: ShownCamera) -> DepthMaps:
    """Depth maps of a camera's training images, and of those that are shared with it, in their order.

    Unknown are pixels around moving objects, pixels that show nothing, and depth edges where no surface of
    those around is confirmed. Depths that no other image's map confirms are negative. No image's depth
    depends on an image for validation but its own: rendered, such an image knows nothing of its own pixels.
    Of the scan of its instant it knows what its neighbours' maps do.

    Args:
        network: Compares the images.
        camera: Whose images have no depths yet; any of those that share theirs.
    """
    world, images = camera.drive.world, camera.images
    shown, recording = world.recording.cameras[camera.name].training, world.recording
    poses, time_s = camera.shared.poses(recording), camera.shared.times_s(recording)
    around_movers, recorded, for_validation = images.moving, images.full.cpu(), camera.for_validation

    def known_beside(number: int) -> list[int]:
        return [k for k in range(len(poses)) if k != number and k not in for_validation]

    def neighbours(number: int, most: int) -> list[int]:
        return baseline_sources(poses, number, known_beside(number), most)

    def depth(number: int) -> tuple[np.ndarray, np.ndarray]:
        instant_s = float(time_s[number])
        moving = world.moving(instant_s, time_s)
        lidar = lidar_view(poses[number], shown.pinhole, world.static_points(instant_s), moving)
        view = camera_view(
            poses[number], shown.pinhole, lidar, images, poses, camera.spec,
            instant=camera.shared.instant, leave_out=for_validation - {number}, own=number,
            moving=moving,
        )  # fmt: skip
        inverse = image_inverse_depth(network, view.to(images.full.device), camera.spec).cpu().numpy()
        mover = np.zeros(inverse.shape, np.int16)
        for place, each in enumerate(moving, start=1):
            assert view.label is not None
            is_it = (view.label.numpy() == place) & _is_at(inverse, each, poses[number])
            mover[is_it & shown.valid] = each.number
        compared = ComparedImages(recorded, poses, shown.pinhole, number, known_beside(number))
        inverse, mover = outlined(inverse, mover, moving, compared)
        mover[~shown.valid] = 0
        found, is_static = without_edges(inverse), shown.valid & (mover == 0)
        if around_movers is not None:
            is_static &= ~around_movers[number].cpu().numpy()
        own = np.ascontiguousarray(recorded[number].permute(1, 2, 0).numpy())
        sources = static_sources(recorded, neighbours(number, COMPARED), poses, number)
        sharp = sharpened(np.where(is_static, found, _UNKNOWN), own, lidar, sources, shown.pinhole)
        return np.where(is_static, sharp, np.where(mover > 0, found, _UNKNOWN)), mover

    count, at_once = len(time_s), images_at_once(shown.pinhole.width * shown.pinhole.height)
    inverse, mover = (np.stack(each) for each in zip(*in_parts(depth, count, at_once), strict=True))

    def asked(number: int) -> np.ndarray:
        others = neighbours(number, ASKED)
        return agreed(inverse[number], number, others, inverse, poses, mover[number] == 0, shown.pinhole)

    return DepthMaps(torch.from_numpy(np.stack(in_parts(asked, count))), torch.from_numpy(mover))


def _is_at(inverse: np.ndarray, mover: MovingPoints, pose: np.ndarray) -> np.ndarray:
    """(H, W) bool: depths at which an object's points lie, as the camera sees them."""
    z_m = transform_points(invert_pose(pose), mover.points_m)[:, 2]
    return (inverse * (z_m.max() + _MARGIN_M) >= 1.0) & (inverse * max(z_m.min() - _MARGIN_M, 1e-3) <= 1.0)
