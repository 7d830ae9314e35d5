"""The residual recipes' camera: its networks trained by leaving images out, judged, and rendered with."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from nvsf_core._types import Scalar
from nvsf_core.fields.camera_networks import CameraEnsemble
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.metrics.elementwise import psnr
from nvsf_core.models.baselines.reproject import depth_points, warping_renderer
from nvsf_core.models.residual.camera_step import camera_step, depth_step
from nvsf_core.models.residual.dynamic_masks import MovingWorld
from nvsf_core.models.residual.left_out import LeftOut
from nvsf_core.models.residual.pose_refinement import AlignedDrive, align_drive, aligned_by, facts_of
from nvsf_core.models.selection.holdout import compare, validation_numbers
from nvsf_core.recipe import CameraSpec, ResidualRecipe, TrainingSpec
from nvsf_core.recording.drive import Recording
from nvsf_core.rendering.camera_view import (
    CameraView,
    ShownImages,
    camera_view,
    middle_factor,
    shown_images,
    shrinking,
)
from nvsf_core.rendering.image_alignment import PoseCorrection
from nvsf_core.rendering.learned_warp import render_view
from nvsf_core.rendering.rendered import RenderedImage
from nvsf_core.rendering.reproject_camera import render_by_warping
from nvsf_core.rendering.warping import to_float
from nvsf_core.simulation.scene_model import ImageRenderer
from nvsf_core.training.loop import TrainingState, make_optimiser
from nvsf_core.training.session import TrainingSession, fit

_METRICS = {"psnr_db": True}
LEARNED = "learned_cameras"
"""Name of the fact: cameras whose networks beat `reproject` on left-out images."""
ALIGNED = "camera_corrections"
"""Name of the fact: by how much the images' poses are off, see `facts_of`."""
_FEWEST_IMAGES = 3
"""With fewer, an image that is left out has no two others to be shown by."""


@dataclass(frozen=True, slots=True)
class TrainedCamera:
    """What training gave beside the networks' weights."""

    states: dict[str, TrainingState]
    preparation_seconds: float
    """All that training took beside the networks' steps, the judges' verdict included."""
    metadata: dict[str, Scalar]
    learned: list[str]
    """Cameras that the networks show; the others stay with `reproject`."""
    corrections: dict[str, dict[str, object]]
    """Of the images' poses, by camera."""


def train_camera(
    session: TrainingSession, networks: CameraEnsemble, recipe: ResidualRecipe, recording: Recording
) -> TrainedCamera:
    """Train all networks on every image that is not a judge, then ask the judges."""
    started = time.perf_counter()
    usable = [name for name in recording.cameras if _images(recording, name) >= _FEWEST_IMAGES]
    given = aligned_by(MovingWorld(recording), {})
    shown = {name: _shown(given.world, name, recipe.camera) for name in usable}
    examples = [
        left_out(given, name, index, shown[name], recipe.camera)
        for name in usable
        for index in range(_images(recording, name))
        if index not in validation_images(_images(recording, name), recipe.camera)
    ]
    if not examples:
        few: dict[str, Scalar] = {"camera_shows": "reproject: too few images to learn from"}
        return TrainedCamera({}, time.perf_counter() - started, few, [], {})
    session.say("camera", f"{len(examples)} images to learn from")
    depth = _fresh(session, nn.ModuleList(one.depth for one in networks), recipe.depth_training, 1)
    preparation = time.perf_counter() - started
    fit(
        session, "depth", depth, recipe.depth_training,
        lambda _, generator: (depth_step(one.depth, examples, recipe, generator) for one in networks),
    )  # fmt: skip
    # Depths that planes alone are compared by start the networks well; both then learn for the image.
    both = _fresh(session, networks, recipe.camera_training, 2)
    fit(
        session, "camera", both, recipe.camera_training,
        lambda _, generator: (camera_step(one, examples, recipe, generator) for one in networks),
    )  # fmt: skip
    judging = time.perf_counter()
    verdict, learned, corrections = _verdict(networks, given, shown, recipe.camera)
    preparation += time.perf_counter() - judging
    metadata: dict[str, Scalar] = {"left_out_images": len(examples)} | verdict
    states = {"depth": depth, "camera": both}
    return TrainedCamera(states, preparation, metadata, learned, facts_of(corrections))


def _verdict(
    networks: CameraEnsemble, given: AlignedDrive, shown: Mapping[str, ShownImages], spec: CameraSpec
) -> tuple[dict[str, Scalar], list[str], dict[str, PoseCorrection]]:
    """What the judges say of cameras: figures, whom the networks show, and whose images are aligned how.

    Images stay as given where aligned ones do not show the judges better. For that question judges are not
    aligned with the others, whose poses would know their pixels; afterwards all are.
    """
    recording = given.given
    left_out = {name: validation_images(_images(recording, name), spec) for name in shown}
    aligned = aligned_by(given.world, align_drive(given.world, list(shown) if spec.aligned else [], left_out))
    metadata: dict[str, Scalar] = {}
    learned, better = [], []
    for name, images in shown.items():
        candidates = {
            "learned": _by_networks(networks, given, name, images, spec),
            "reproject": _by_warping(recording, name),
        }
        if name in aligned.corrections:
            candidates["aligned"] = _by_networks(networks, aligned, name, images, spec)
        found, ours = compare(_METRICS, left_out[name], candidates), "learned"
        if "aligned" in candidates:
            gain_db = found.of("aligned", "psnr_db") - found.of("learned", "psnr_db")
            metadata[f"{name}_judged_aligned_gain_db"] = gain_db
            if found.wins("aligned", "learned"):
                ours = "aligned"
                better.append(name)
        is_better = found.wins(ours, "reproject")
        metadata |= found.figures({ours: f"{name}_judged_", "reproject": f"{name}_judged_reproject_"})
        metadata[f"{name}_shows"] = "learned" if is_better else "reproject: learning did not beat it"
        if is_better:
            learned.append(name)
    return metadata, learned, align_drive(given.world, better)


def camera_renderer(
    networks: CameraEnsemble,
    recording: Recording,
    spec: CameraSpec,
    learned: Sequence[str],
    corrections: Mapping[str, PoseCorrection],
) -> ImageRenderer:
    """Images by the networks where they beat `reproject`, else by that."""
    warp = warping_renderer(recording)
    drive = aligned_by(MovingWorld(recording), corrections)
    world = drive.world
    shown = {name: _shown(world, name, spec) for name in learned}

    def render(camera: str, pinhole: Pinhole, pose: np.ndarray, time_s: float) -> RenderedImage:
        if camera not in learned:
            return warp(camera, pinhole, pose, time_s)
        one = world.recording.cameras[camera]
        view = camera_view(
            drive.pose_at(camera, pose, time_s), pinhole, world.static_points(time_s), shown[camera],
            one.training.pose, spec, moving=world.moving(time_s, one.training_time_s),
        )  # fmt: skip
        return render_view(networks, view, spec)

    return render


def validation_images(images: int, spec: CameraSpec) -> range:
    """Numbers of the training images that are never learned from; at least one, never all."""
    return validation_numbers(images, spec.judge_every, spec.judge_every // 3)


def _by_networks(
    networks: CameraEnsemble, drive: AlignedDrive, camera: str, images_shown: ShownImages, spec: CameraSpec
) -> Callable[[int], list[float]]:
    """Scores of a left-out image as the networks show it."""

    def score(index: int) -> list[float]:
        view = _left_out_view(drive, camera, index, images_shown, spec)
        return _scores(drive.given, camera, index, render_view(networks, view, spec))

    return score


def _by_warping(recording: Recording, camera: str) -> Callable[[int], list[float]]:
    """Scores of a left-out image as `reproject` shows it."""
    one = recording.cameras[camera]
    images = one.training

    def score(index: int) -> list[float]:
        others = np.arange(len(images.rgb)) != index
        points = depth_points(recording, float(one.training_time_s[index]), leave_out=True)
        shown = render_by_warping(
            images.pose[index], images.pinhole, points,
            images.rgb[others], images.pose[others], source_valid=images.valid,
        )  # fmt: skip
        return _scores(recording, camera, index, shown)

    return score


def _scores(recording: Recording, camera: str, index: int, shown: RenderedImage) -> list[float]:
    """PSNR in dB of a shown training image, where it was recorded."""
    images = recording.cameras[camera].training
    return [psnr(shown.rgb[images.valid] / 255.0, images.rgb[index][images.valid] / 255.0, 1.0).value]


def left_out(
    drive: AlignedDrive, camera: str, index: int, images_shown: ShownImages, spec: CameraSpec
) -> LeftOut:
    """A training image as the others know it; `images_shown` are all of the camera's."""
    view = _left_out_view(drive, camera, index, images_shown, spec)
    truth = drive.given.cameras[camera].training.rgb[index]
    middle, small = (
        functional.avg_pool2d(to_float(truth[None]), by)[0]
        for by in (middle_factor(view.factor), view.factor)
    )
    return LeftOut(view, torch.from_numpy(truth).permute(2, 0, 1), middle, small)


def _left_out_view(
    drive: AlignedDrive, camera: str, index: int, images_shown: ShownImages, spec: CameraSpec
) -> CameraView:
    world = drive.world
    one = world.recording.cameras[camera]
    images, time_s = one.training, float(one.training_time_s[index])
    return camera_view(
        drive.left_out_pose(camera, index), images.pinhole, world.static_points(time_s, leave_out=True),
        images_shown, images.pose, spec, leave_out=index,
        moving=world.moving(time_s, one.training_time_s, leave_out=True),
    )  # fmt: skip


def _shown(world: MovingWorld, camera: str, spec: CameraSpec) -> ShownImages:
    one = world.recording.cameras[camera]
    images = one.training
    factor = shrinking(images.pinhole, spec)
    return shown_images(images.rgb, images.valid, factor, world.shadows(one))


def _images(recording: Recording, camera: str) -> int:
    return len(recording.cameras[camera].training.rgb)


def _fresh(session: TrainingSession, model: nn.Module, spec: TrainingSpec, number: int) -> TrainingState:
    """A network before its first step; each of a scene draws windows of its own."""
    generator = torch.Generator().manual_seed(session.seed * 3 + number)
    return TrainingState(model, make_optimiser(model, spec), generator)
