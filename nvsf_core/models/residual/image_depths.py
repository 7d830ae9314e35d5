"""Depth maps of the training images: what each image shows, compared with the images around it."""

import numpy as np
import torch
from torch import Tensor

from nvsf_core.fields.camera_networks import CameraEnsemble
from nvsf_core.kernels.depth_splat import without_edges
from nvsf_core.kernels.threads import in_parts
from nvsf_core.models.residual.pose_refinement import AlignedDrive
from nvsf_core.recipe import CameraSpec
from nvsf_core.rendering.camera_view import ShownImages, camera_view
from nvsf_core.rendering.learned_warp import view_inverse_depth


def image_depths(
    networks: CameraEnsemble, drive: AlignedDrive, camera: str, images: ShownImages, spec: CameraSpec,
    validation: range,
) -> Tensor:
    """Inverse depths (j, H, W) float32, 1/m, of a camera's training images; 0 = unknown.

    Unknown are depth edges, pixels of moving objects and pixels that show nothing. No image's depth depends on
    an image for validation but its own, so a rendered validation image knows nothing of its own pixels.

    Args:
        networks: Whose depth networks compare the images.
        drive: With the images' poses.
        camera: Name.
        images: All of the camera's training images, without depths.
        spec: Of the recipe.
        validation: Numbers of the images for validation.
    """
    world = drive.world
    one = world.recording.cameras[camera]
    shown, time_s = one.training, one.training_time_s
    hidden = world.shadows(one)

    def depth(number: int) -> Tensor:
        instant_s = float(time_s[number])
        view = camera_view(
            shown.pose[number], shown.pinhole, world.static_points(instant_s), images, shown.pose, spec,
            leave_out=set(validation) - {number}, own=number, moving=world.moving(instant_s, time_s),
        )  # fmt: skip
        inverse = without_edges(view_inverse_depth(networks, view.to(images.full.device), spec).cpu().numpy())
        known = shown.valid if hidden is None else shown.valid & ~hidden[number]
        return torch.from_numpy(np.where(known, inverse, np.float32(0.0)))

    return torch.stack(in_parts(depth, len(time_s)))
