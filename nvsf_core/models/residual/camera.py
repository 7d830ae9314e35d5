"""The cameras of the residual family: depths of their images, comparison with `reproject`, rendering."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nvsf_core._types import Scalar
from nvsf_core.fields.depth_network import DepthNetwork
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.kernels.threads import images_at_once, in_parts
from nvsf_core.metrics.elementwise import psnr
from nvsf_core.models.baselines.reproject import depth_points, warping_renderer
from nvsf_core.models.family import TrainedPart, TrainingSession, Weights, fit, training_device
from nvsf_core.models.holdout import compare
from nvsf_core.models.residual.camera_examples import RecordedView, ShownCamera
from nvsf_core.models.residual.depth_step import depth_step
from nvsf_core.models.residual.dynamic_masks import MovingWorld
from nvsf_core.models.residual.exposures import Exposures, exposures_of
from nvsf_core.models.residual.image_depths import image_depths
from nvsf_core.models.residual.pose_refinement import (
    AlignedDrive,
    align_drive,
    aligned_by,
    facts_of,
    from_facts,
)
from nvsf_core.models.residual.shared_images import SharedImages, shared_by, shared_images
from nvsf_core.models.residual.tones import ToneCurve, tones_of, with_tones
from nvsf_core.recipe.residual import CameraSpec, ResidualRecipe, TrainingSpec
from nvsf_core.recording.drive import Recording
from nvsf_core.rendering.camera_view import ShownImages, camera_view, shown_images, shrinking
from nvsf_core.rendering.image_alignment import PoseCorrection
from nvsf_core.rendering.image_depth import without_sky
from nvsf_core.rendering.lidar_view import lidar_view
from nvsf_core.rendering.rendered import RenderedImage
from nvsf_core.rendering.reproject_camera import render_by_warping
from nvsf_core.rendering.source_blend import render_view
from nvsf_core.rendering.view_depth_maps import DepthMaps
from nvsf_core.simulation.scene_model import ImageRenderer
from nvsf_core.training.loop import fresh_state, side_by_side

_DB = "psnr_db"
_METRICS = {_DB: True}
LEARNED = "learned_cameras"
"""Name of the fact: cameras whose views by learned depths beat `reproject` on validation images."""
ALIGNED = "camera_corrections"
"""Name of the fact: corrections of the images' poses, see `facts_of`."""
_FEWEST_IMAGES = 3
"""With fewer, an image that is left out has no two others to be rendered from."""
_WINDOWS_AN_IMAGE = 8
"""At least so many windows are sampled of each image that is prepared to learn from."""
SHARED = "shared_images"
"""Name of the fact: lists of the cameras that share their images."""
TONES = "tones"
"""Name of the fact: by camera, gain and exponent of its `ToneCurve`."""
EXPOSURES = "exposures"
"""Name of the fact: by camera, times and logarithms of gains of its images, see `Exposures`."""
ALONE = "cameras_alone"
"""Name of the fact: cameras whose views do without the images that are shared with them."""
_MAPS = "depth_maps"
"""First part of the names of the stored depth maps."""


def train_camera(session: TrainingSession, recipe: ResidualRecipe, recording: Recording) -> TrainedPart:
    """Learn the depths of the training images, then decide on the validation images whether to use them."""
    started = time.perf_counter()
    usable = [name for name, one in recording.cameras.items() if len(one.training.rgb) >= _FEWEST_IMAGES]
    shared = shared_images(recording, usable)
    tones = tones_of(recording, shared)
    given = aligned_by(MovingWorld(with_tones(recording, tones)), {})
    exposures = exposures_of(given.world, usable)
    cameras = _by_name(given, shared, recipe.camera, exposures)
    if not cameras:
        few: dict[str, Scalar] = {"camera_shows": "reproject: too few images to learn from"}
        return TrainedPart(
            states={}, preparation_seconds=time.perf_counter() - started, metadata=few,
            facts={LEARNED: [], ALIGNED: {}, SHARED: [], TONES: {}, ALONE: [], EXPOSURES: {}},
        )  # fmt: skip
    session.say("camera", f"{sum(len(one.training) for one in cameras.values())} images to learn from")
    device, spec = training_device(), recipe.depth_training
    there = {one.name: cameras[one.name].images.to(device) for one in shared}
    compared = {name: replace(one, images=there[one.shared.name]) for name, one in cameras.items()}
    examples = _examples(compared, spec)
    network = DepthNetwork(recipe.camera, torch.Generator().manual_seed(session.seed + 1)).to(device)
    state = fresh_state(network, spec, session.seed * 3 + 1)
    preparation = time.perf_counter() - started
    fit(
        session, "depth", state, spec,
        lambda _, generator: side_by_side(
            spec.parts, generator, partial(depth_step, network, examples, recipe)
        ),
    )  # fmt: skip
    placing = time.perf_counter()
    maps = {one.name: image_depths(network, compared[one.name]) for one in shared}
    # They hold all images without depths.
    examples.clear()
    compared.clear()
    there.clear()
    shown = {name: cameras[name].images.with_depths(one) for name, one in maps.items()}
    cameras = {name: replace(one, images=shown[one.shared.name]) for name, one in cameras.items()}
    verdict, facts = _verdict(given, cameras, recipe.camera, exposures)
    return TrainedPart(
        states={"depth": state}, preparation_seconds=preparation + time.perf_counter() - placing,
        metadata=verdict,
        facts=facts | {
            SHARED: [list(one.cameras) for one in shared],
            TONES: {name: (one.gain, one.exponent) for name, one in tones.items()},
            EXPOSURES: facts_of(exposures),
        },
        tensors={key: value for name, one in maps.items() for key, value in _stored_maps(name, one).items()},
    )  # fmt: skip


def _by_name(
    given: AlignedDrive,
    shared: Sequence[SharedImages],
    spec: CameraSpec,
    exposures: Mapping[str, Exposures],
) -> dict[str, ShownCamera]:
    """All cameras that can be learned from, with their images, which have no depths yet."""
    return {
        name: ShownCamera(given, name, one, images, spec, exposures.get(name))
        for one in shared
        for images in [_shown(given.world, one, spec, exposures)]
        for name in one.cameras
    }


def _examples(cameras: Mapping[str, ShownCamera], spec: TrainingSpec) -> list[RecordedView]:
    """Training images to learn from, evenly spread.

    One of which few windows are sampled costs more than it teaches.
    """
    images = [(one, index) for one in cameras.values() for index in one.training]
    count = min(len(images), max(1, spec.steps * spec.parts // _WINDOWS_AN_IMAGE))

    def example(place: int) -> RecordedView:
        camera, index = images[place * len(images) // count]
        return camera.itself(index)

    return in_parts(example, count)


def _verdict(
    given: AlignedDrive,
    cameras: Mapping[str, ShownCamera],
    spec: CameraSpec,
    exposures: Mapping[str, Exposures],
) -> tuple[dict[str, Scalar], dict[str, Any]]:
    """Scores on the validation images, and as facts the cameras that use depths, and how.

    A camera does without the images that are shared with it if its validation images are better without.
    Images are aligned only if that raises the PSNR on the validation images of all cameras that share them.
    These take no part in the alignment that is scored, or the other images' poses would depend on their
    pixels; the corrections that are returned are of all images.
    """
    left_out = {name: one.validation for name, one in cameras.items()}
    aligning = list(cameras) if spec.aligned else []
    aligned = aligned_by(given.world, align_drive(given.world, aligning, left_out, exposures))
    scores = {
        name: compare(
            _METRICS,
            one.validation,
            _candidates(given, aligned, one),
            at_once=images_at_once(one.images.full[0, 0].numel()),
        )
        for name, one in cameras.items()
    }
    metadata: dict[str, Scalar] = {}
    learned, better, alone = [], [], []
    for name, found in scores.items():
        ours = "learned"
        if name in aligned.corrections:
            metadata[f"{name}_judged_aligned_gain_db"] = found.of("aligned", _DB) - found.of(ours, _DB)
            sharing = [scores[other] for other in cameras[name].shared.cameras]
            if sum(one.of("aligned", _DB) - one.of("learned", _DB) for one in sharing) > 0.0:
                ours = "aligned"
                better.append(name)
        if "alone" in found.means:
            metadata[f"{name}_judged_shared_gain_db"] = found.of("learned", _DB) - found.of("alone", _DB)
            if found.wins("alone", "learned"):
                ours = "alone"
                alone.append(name)
        is_better = found.wins(ours, "reproject")
        metadata |= found.figures({ours: f"{name}_judged_", "reproject": f"{name}_judged_reproject_"})
        metadata[f"{name}_shows"] = "learned" if is_better else "reproject: learning did not beat it"
        if is_better:
            learned.append(name)
    corrections = align_drive(given.world, better, exposures=exposures)
    return metadata, {LEARNED: learned, ALIGNED: facts_of(corrections), ALONE: alone}


def _candidates(
    given: AlignedDrive, aligned: AlignedDrive, camera: ShownCamera
) -> dict[str, Callable[[int], list[float]]]:
    """What a camera's validation images may be rendered by, each as a function that scores one of them."""
    found = {"learned": _by_depths(camera), "reproject": _by_warping(given.given, camera.name)}
    if camera.name in aligned.corrections:
        found["aligned"] = _by_depths(replace(camera, drive=aligned, returns={}))
    if len(camera.shared.cameras) > 1:
        found["alone"] = _by_depths(camera, alone=True)
    return found


def camera_renderer(recording: Recording, spec: CameraSpec, weights: Weights) -> ImageRenderer:
    """Renders images by learned depths for the cameras that use them, by `reproject` for the others.

    Raises:
        StoreError: A depth map is absent.
    """
    warp, facts = warping_renderer(recording), weights.facts
    tones = {name: ToneCurve(*map(tuple, one)) for name, one in facts[TONES].items()}
    corrections = from_facts(PoseCorrection, facts[ALIGNED])
    exposures = from_facts(Exposures, facts[EXPOSURES])
    drive = aligned_by(MovingWorld(with_tones(recording, tones)), corrections)
    world, learned, alone = drive.world, facts[LEARNED], facts[ALONE]
    shared = {
        name: one for one in shared_by(recording, facts[SHARED]) for name in one.cameras if name in learned
    }
    shown = {
        one.name: _shown(world, one, spec, exposures).with_depths(_maps_from(weights, one.name))
        for one in set(shared.values())
    }

    def render(
        camera: str, pinhole: Pinhole, pose: np.ndarray, time_s: float, near_s: float | None = None
    ) -> RenderedImage:
        if camera not in shared:
            return warp(camera, pinhole, pose, time_s, near_s)
        one, place_s = shared[camera], time_s if near_s is None else near_s
        at = drive.pose_at(camera, pose, place_s)
        moving = world.moving(time_s, one.times_s(recording), from_m=pose[:3, 3])
        lidar = lidar_view(at, pinhole, world.static_points(place_s), moving)
        poses = one.poses(world.recording)
        others = one.of_others(camera) if camera in alone else ()
        view = camera_view(
            at, pinhole, lidar, shown[one.name], poses, spec, instant=one.instant, leave_out=others,
            moving=moving,
        )  # fmt: skip
        view = replace(view, off_path_m=one.off_path_m(world.recording, at[:3, 3]))
        if camera in exposures:
            view = replace(view, log_gain=exposures[camera].at(place_s))
        sources = view.near.of(view.images.full)
        found = without_sky(render_view(view), at, pinhole, sources, view.gap_px, label=view.label)
        return replace(found, rgb=tones[camera].inverse().of(found.rgb)) if camera in tones else found

    return render


def _stored_maps(camera: str, maps: DepthMaps) -> dict[str, Tensor]:
    """Depth maps as tensors to store under a camera's name; half precision is exact to 0.05 %."""
    mover = {f"{_MAPS}.{camera}.mover": maps.mover} if maps.mover.any() else {}
    return {f"{_MAPS}.{camera}.inverse": maps.inverse.half(), **mover}


def _maps_from(weights: Weights, camera: str) -> DepthMaps:
    """A camera's depth maps from stored tensors."""
    inverse, mover = weights.tensor(f"{_MAPS}.{camera}.inverse").float(), f"{_MAPS}.{camera}.mover"
    has_movers = weights.has(mover)
    return DepthMaps(inverse, weights.tensor(mover) if has_movers else torch.zeros(inverse.shape).short())


def _by_depths(camera: ShownCamera, *, alone: bool = False) -> Callable[[int], list[float]]:
    """Scores a left-out image as the others show it; `alone`: from this camera's images only."""

    def score(index: int) -> list[float]:
        shown = render_view(camera.from_others(index, alone=alone))
        return _scores(camera.drive.given, camera.name, index, shown)

    return score


def _by_warping(recording: Recording, camera: str) -> Callable[[int], list[float]]:
    """Scores a left-out image as `reproject` renders it."""
    one = recording.cameras[camera]
    images = one.training

    def score(index: int) -> list[float]:
        others = np.arange(len(images.rgb)) != index
        time_s, frame = float(one.training_time_s[index]), int(one.training_frame[index])
        points = depth_points(recording, time_s, leave_out=frame)
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


def _shown(
    world: MovingWorld, shared: SharedImages, spec: CameraSpec, exposures: Mapping[str, Exposures]
) -> ShownImages:
    cameras = [world.recording.cameras[name] for name in shared.cameras]
    first, shadows = cameras[0].training, [world.shadows(one) for one in cameras]
    known = [one for one in shadows if one is not None]
    moving = np.concatenate(known) if known else None
    fixed, gains = np.zeros(shared.count), [exposures.get(name) for name in shared.cameras]
    log_gain = np.concatenate([fixed if one is None else one.log_gain for one in gains])
    return shown_images(
        shared.rgb(world.recording), first.valid, shrinking(first.pinhole, spec), moving, log_gain
    )
