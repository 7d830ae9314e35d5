"""The camera networks of the residual family: training, comparison with `reproject`, rendering."""

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from nvsf_core._types import Scalar
from nvsf_core.fields.camera_networks import CameraEnsemble
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.kernels.threads import in_parts
from nvsf_core.losses.total import LossBreakdown
from nvsf_core.metrics.elementwise import psnr
from nvsf_core.models.baselines.reproject import depth_points, warping_renderer
from nvsf_core.models.family import TrainedPart
from nvsf_core.models.residual.camera_step import camera_step, depth_step
from nvsf_core.models.residual.dynamic_masks import MovingWorld
from nvsf_core.models.residual.image_depths import image_depths
from nvsf_core.models.residual.left_out import LeftOut
from nvsf_core.models.residual.pose_refinement import AlignedDrive, align_drive, aligned_by, facts_of
from nvsf_core.models.selection.holdout import compare, validation_numbers
from nvsf_core.recipe import CameraSpec, ResidualRecipe
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
from nvsf_core.training.device import training_device
from nvsf_core.training.loop import Part, fresh_state, side_by_side
from nvsf_core.training.session import TrainingSession, fit

_METRICS = {"psnr_db": True}
LEARNED = "learned_cameras"
"""Name of the fact: cameras whose networks beat `reproject` on validation images."""
ALIGNED = "camera_corrections"
"""Name of the fact: corrections of the images' poses, see `facts_of`."""
_FEWEST_IMAGES = 3
"""With fewer, an image that is left out has no two others to be rendered from."""
_BLOCKS_M = (1.0, 2.0, 4.0)
"""Each image is also rendered without the images within one of these distances, so that the networks learn to
look from farther away."""


def train_camera(
    session: TrainingSession, networks: CameraEnsemble, recipe: ResidualRecipe, recording: Recording
) -> TrainedPart:
    """Train all networks on the training images, then decide on the validation images whether to use them."""
    started = time.perf_counter()
    device = training_device()
    networks.to(device)
    usable = [name for name in recording.cameras if _images(recording, name) >= _FEWEST_IMAGES]
    given = aligned_by(MovingWorld(recording), {})
    shown = {name: _shown(given.world, name, recipe.camera).to(device) for name in usable}
    wanted = [
        (name, index)
        for name in usable
        for index in range(_images(recording, name))
        if index not in validation_images(_images(recording, name), recipe.camera)
    ]

    def alone(number: int) -> LeftOut:
        name, index = wanted[number]
        return left_out(given, name, index, shown[name], recipe.camera, {index}).to(device)

    def in_block(number: int) -> LeftOut:
        name, index = wanted[number]
        around = block(given.given, name, index, _BLOCKS_M[number % len(_BLOCKS_M)])
        return left_out(given, name, index, shown[name], recipe.camera, around).to(device)

    def itself(number: int) -> LeftOut:
        name, index = wanted[number]
        judges = set(validation_images(_images(recording, name), recipe.camera))
        return left_out(given, name, index, shown[name], recipe.camera, judges, own=index).to(device)

    examples = in_parts(itself, len(wanted))
    if not examples:
        few: dict[str, Scalar] = {"camera_shows": "reproject: too few images to learn from"}
        return TrainedPart(
            states={}, preparation_seconds=time.perf_counter() - started, metadata=few,
            facts={LEARNED: [], ALIGNED: {}},
        )  # fmt: skip
    session.say("camera", f"{len(examples)} images to learn from")
    depths = nn.ModuleList(one.depth for one in networks)
    depth = fresh_state(depths, recipe.depth_training, session.seed * 3 + 1)
    preparation = time.perf_counter() - started
    # First the depth networks alone, by comparing planes; then all networks, for the image.
    fit(
        session, "depth", depth, recipe.depth_training,
        lambda _, generator: _of_members(
            recipe.depth_training.parts, generator,
            [partial(depth_step, one.depth, examples, recipe) for one in networks],
        ),
    )  # fmt: skip
    placing = time.perf_counter()
    for name in usable:
        judges = validation_images(_images(recording, name), recipe.camera)
        maps = image_depths(networks, given, name, shown[name], recipe.camera, judges)
        shown[name] = shown[name].with_depths(maps.to(device))
    examples = in_parts(alone, len(wanted)) + in_parts(in_block, len(wanted))
    preparation += time.perf_counter() - placing
    print("placing", time.perf_counter() - placing, flush=True)
    drawing = nn.ModuleList(part for one in networks for part in (one.blend, one.refine) if part is not None)
    both = fresh_state(drawing, recipe.camera_training, session.seed * 3 + 2)
    fit(
        session, "camera", both, recipe.camera_training,
        lambda _, generator: _of_members(
            recipe.camera_training.parts, generator,
            [partial(camera_step, one, examples, recipe) for one in networks],
        ),
    )  # fmt: skip
    validating = time.perf_counter()
    verdict, learned, corrections = _verdict(networks, given, shown, recipe.camera)
    preparation += time.perf_counter() - validating
    global TRIAL
    TRIAL = shown
    return TrainedPart(
        states={"depth": depth, "camera": both}, preparation_seconds=preparation,
        metadata={"left_out_images": len(examples)} | verdict,
        facts={LEARNED: learned, ALIGNED: facts_of(corrections)},
    )  # fmt: skip


def _of_members(
    parts: int, generator: torch.Generator, losses: Sequence[Callable[[torch.Generator], LossBreakdown]]
) -> list[Part]:
    """The parts of a step of all members, each of whose losses is in `losses`."""
    return [part for loss in losses for part in side_by_side(parts, generator, loss)]


def _verdict(
    networks: CameraEnsemble, given: AlignedDrive, shown: Mapping[str, ShownImages], spec: CameraSpec
) -> tuple[dict[str, Scalar], list[str], dict[str, PoseCorrection]]:
    """Scores on the validation images, the cameras that use the networks, and the pose corrections to use.

    A camera's images are aligned only if that raises the PSNR on its validation images. These take no part
    in the alignment that is scored, or the other images' poses would depend on their pixels; the corrections
    that are returned are of all images.
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
    """Renders images by the networks for the cameras in `learned`, by `reproject` for the others.

    Args:
        networks: Trained.
        recording: The drive.
        spec: Of the recipe.
        learned: Names of cameras.
        corrections: Of the images' poses, by camera.
    """
    warp, device = warping_renderer(recording), training_device()
    networks.to(device)
    drive = aligned_by(MovingWorld(recording), corrections)
    world = drive.world
    shown = {name: _shown(world, name, spec).to(device) for name in learned}
    shown = TRIAL

    def render(camera: str, pinhole: Pinhole, pose: np.ndarray, time_s: float) -> RenderedImage:
        if camera not in learned:
            return warp(camera, pinhole, pose, time_s)
        one = world.recording.cameras[camera]
        view = camera_view(
            drive.pose_at(camera, pose, time_s), pinhole, world.static_points(time_s), shown[camera],
            one.training.pose, spec, moving=world.moving(time_s, one.training_time_s),
        )  # fmt: skip
        return render_view(networks, view.to(device), spec)

    return render


def validation_images(images: int, spec: CameraSpec) -> range:
    """Numbers of the training images that are for validation; at least one, never all."""
    return validation_numbers(images, spec.judge_every, spec.judge_every // 3)


def _by_networks(
    networks: CameraEnsemble, drive: AlignedDrive, camera: str, images_shown: ShownImages, spec: CameraSpec
) -> Callable[[int], list[float]]:
    """Scores a left-out image as the networks render it."""

    def score(index: int) -> list[float]:
        view = _left_out_view(drive, camera, index, images_shown, spec, {index}).to(images_shown.full.device)
        return _scores(drive.given, camera, index, render_view(networks, view, spec))

    return score


def _by_warping(recording: Recording, camera: str) -> Callable[[int], list[float]]:
    """Scores a left-out image as `reproject` renders it."""
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
    """PSNR in dB of a rendered training image over the valid pixels."""
    images = recording.cameras[camera].training
    return [psnr(shown.rgb[images.valid] / 255.0, images.rgb[index][images.valid] / 255.0, 1.0).value]


def block(recording: Recording, camera: str, index: int, radius_m: float) -> set[int]:
    """Numbers of a camera's training images within a distance of one of them, itself among them.

    At least two images are left.
    """
    position_m = recording.cameras[camera].training.pose[:, :3, 3]
    distance_m = np.linalg.norm(position_m - position_m[index], axis=1)
    order = np.argsort(distance_m, kind="stable")
    inside = int(np.count_nonzero(distance_m <= radius_m))
    return {index} | set(order[: min(inside, len(order) - 2)].tolist())


def left_out(
    drive: AlignedDrive, camera: str, index: int, images_shown: ShownImages, spec: CameraSpec,
    without: Collection[int], own: int | None = None,
) -> LeftOut:
    """A training image as a held-out view that the other images render.

    Args:
        drive: With the images' poses.
        camera: Name.
        index: Of the image among the camera's training images.
        images_shown: All of the camera's training images.
        spec: Of the recipe.
        without: Numbers of the images that are no sources, this one among them.
    """
    view = _left_out_view(drive, camera, index, images_shown, spec, without, own)
    truth = drive.given.cameras[camera].training.rgb[index]
    middle, small = (
        functional.avg_pool2d(to_float(truth[None]), by)[0]
        for by in (middle_factor(view.factor), view.factor)
    )
    return LeftOut(view, torch.from_numpy(truth).permute(2, 0, 1), middle, small)


def _left_out_view(
    drive: AlignedDrive, camera: str, index: int, images_shown: ShownImages, spec: CameraSpec,
    without: Collection[int], own: int | None = None,
) -> CameraView:
    world = drive.world
    one = world.recording.cameras[camera]
    images, time_s = one.training, float(one.training_time_s[index])
    return camera_view(
        drive.left_out_pose(camera, index), images.pinhole, world.static_points(time_s, leave_out=True),
        images_shown, images.pose, spec, leave_out=without, own=own,
        moving=world.moving(time_s, one.training_time_s, leave_out=True),
    )  # fmt: skip


def _shown(world: MovingWorld, camera: str, spec: CameraSpec) -> ShownImages:
    one = world.recording.cameras[camera]
    images = one.training
    factor = shrinking(images.pinhole, spec)
    return shown_images(images.rgb, images.valid, factor, world.shadows(one))


def _images(recording: Recording, camera: str) -> int:
    return len(recording.cameras[camera].training.rgb)
