"""Errors of a curve, measured on a fixed quarter of the LiDAR's rays and a sixteenth of the pixels.

Of the pano every fourth block of 32 columns is compared, and rays are fired there only; of the recorded
returns every fourth; of an image every fourth pixel of every fourth row, as it is at full size.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.common.compared import SHARE, block_colours, block_means
from benchmarks.speed_error.lidar import SECTORS, WHOLE, Answers, model_answers, quarter_of_rays, recorded
from nvsf_core.fields.lidar_field import surface_batch
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.metrics.elementwise import psnr
from nvsf_core.metrics.protocols import MAX_RANGE_M, PanoImage, lidar4d, project_scan
from nvsf_core.metrics.range_and_intensity import ray_range_metrics
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.recipe.residual import EvidenceSpec, ResidualRecipe
from nvsf_core.recording.drive import Recording
from nvsf_core.recording.images import CameraImages
from nvsf_core.rendering.reproject import NEAR_M
from nvsf_core.rendering.warping import shrunk
from nvsf_core.simulation.scene_model import ImageRenderer, SceneModel
from nvsf_core.simulation.sweep_simulation import simulate_sweep
from nvsf_core.stages.views.camera import copied_images
from nvsf_core.stages.views.lidar import copied_scans, warm_up
from nvsf_core.stages.views.view import View, held_out_view
from nvsf_core.stores.arrays import read_arrays
from nvsf_core.stores.scene_store import SceneStore

LIDAR_METRICS = ("chamfer_m2", "f_score", "range_psnr_db", "hit_accuracy")
"""Of the protocol `lidar4d_scan`, on the chosen columns."""
RAW_METRICS = ("range_abs_error_median_m", "range_abs_error_p90_m")
"""Along the chosen recorded returns' own rays."""
IMAGE_METRIC = "image_psnr_db"
_PIXEL_STEP = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Judge:
    """What was recorded in the scored frames."""

    recording: Recording
    view: View
    store: SceneStore

    @property
    def scores_images(self) -> bool:
        """Whether the images that are trained on have the recorded size."""
        folder = self.store.require("undistorted") / "images.zarr"
        return all(
            camera.training.rgb.shape[1:] == read_arrays(folder, f"{name}_rgb")[f"{name}_rgb"].shape[1:]
            for name, camera in self.recording.cameras.items()
        )

    def errors(self, model: SceneModel, *, thin_images: bool) -> dict[str, float]:
        """Errors of a model, without those of images where these are not scored.

        `thin_images`: it can show single pixels, so that no others are rendered.
        """
        found: dict[str, float] = {}
        lidar, plan = self.recording.lidar, self.view.sweeps
        if model.lidar is not None and lidar is not None and plan is not None:
            found |= self.lidar_errors(model_answers(lidar, plan, model))
        if model.camera is not None and self.scores_images:
            found |= self.image_errors(self._rendered(model.camera, thin_images))
        return found

    def copy_errors(self) -> dict[str, float]:
        """Errors of the baseline `copy_nearest`; without those of images where these are not scored."""
        found: dict[str, float] = {}
        lidar, plan = self.recording.lidar, self.view.sweeps
        if lidar is not None and plan is not None:
            copies = copied_scans(lidar, plan)

            def answer(number: int) -> tuple[PanoImage, np.ndarray]:
                names = ("range_m", "intensity", "hit")
                part = slice(*copies["ray_offsets"][number : number + 2].tolist())
                pano = PanoImage(**{name: copies[f"pano_{name}"][number] for name in names})
                return pano, copies["ray_range_m"][part][::SHARE]

            found |= self.lidar_errors(answer)
        if not self.scores_images:
            return found
        images = copied_images(self.recording, self.view.images)
        copied = {name: thinned(images[f"{name}_rgb"]) for name in self.view.images}
        return found | self.image_errors(copied)

    def lidar_errors(self, rendered: Answers) -> dict[str, float]:
        """Means over the scored frames."""
        lidar, plan = self.recording.lidar, self.view.sweeps
        assert lidar is not None and plan is not None
        frames = []
        for number, frame in enumerate(plan.frame.tolist()):
            scan, range_m = recorded(lidar, frame)
            predicted, masked_m = rendered(number)
            truth = SECTORS.cut(project_scan(WHOLE, scan))
            pano = lidar4d(SECTORS.cut(predicted), truth, SECTORS, None)
            near = (range_m > 0.0) & (range_m <= MAX_RANGE_M)
            rays = ray_range_metrics(masked_m[near], range_m[near])
            frames.append(
                {name: pano[name].value for name in LIDAR_METRICS}
                | {name: rays[name].value for name in RAW_METRICS}
            )
        return {name: float(np.mean([frame[name] for frame in frames])) for name in frames[0]}

    def image_errors(self, shown: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Mean PSNR over the scored frames of all cameras, from their thinned images (n, h, w, 3)."""
        folder = self.store.require("undistorted") / "images.zarr"
        scores = []
        for name, images in shown.items():
            keys = (f"{name}_rgb", f"{name}_valid", f"{name}_frame")
            rgb, valid, frame = (read_arrays(folder, *keys)[key] for key in keys)
            seen = thinned(valid[None])[0]
            for image, number in zip(images, self.view.images[name].frame.tolist(), strict=True):
                truth = thinned(rgb[frame == number])[0]
                scores.append(psnr(image[seen] / 255.0, truth[seen] / 255.0, 1.0).value)
        return {IMAGE_METRIC: float(np.mean(scores))} if scores else {}

    def sweep_seconds(self, model: SceneModel) -> float | None:
        """Time of one whole sweep, kernels loaded; None without a LiDAR."""
        lidar, plan = self.recording.lidar, self.view.sweeps
        if model.lidar is None or lidar is None or plan is None:
            return None
        warm_up(lidar, [model.lidar])
        started = time.perf_counter()
        simulate_sweep(model, lidar, plan, float(plan.time_s[0]))
        return time.perf_counter() - started

    def image_seconds(self, model: SceneModel, *, thin: bool) -> float | None:
        """Time of one whole image of each camera, their mean; None without a camera.

        Where single pixels can be shown it is that of a sixteenth, sixteen times.
        """
        if model.camera is None or not self.view.images:
            return None
        spent = []
        for name, plan in self.view.images.items():
            pinhole, poses = self._camera(name, thin)
            started = time.perf_counter()
            model.camera(name, pinhole, poses[0], float(plan.time_s[0]))
            spent.append((time.perf_counter() - started) * (_PIXEL_STEP**2 if thin else 1))
        return float(np.mean(spent))

    def _rendered(self, render: ImageRenderer, thin: bool) -> dict[str, np.ndarray]:
        shown = {}
        for name, plan in self.view.images.items():
            pinhole, poses = self._camera(name, thin)
            instants = zip(poses, plan.time_s.tolist(), strict=True)
            images = np.stack([render(name, pinhole, pose, instant).rgb for pose, instant in instants])
            shown[name] = images if thin else thinned(images)
        return shown

    def _camera(self, name: str, thin: bool) -> tuple[Pinhole, np.ndarray]:
        """What a camera is rendered with, and its poses (n, 4, 4) in the view."""
        camera = self.recording.cameras[name]
        poses: np.ndarray = self.view.images[name].poses(self.recording.trajectory) @ camera.in_lidar
        return thin_pinhole(camera.training.pinhole) if thin else camera.training.pinhole, poses


def judge_of(recording: Recording, store: SceneStore, frames: Sequence[int]) -> Judge:
    """Scores some frames that were not trained on.

    Raises:
        ValueError: None of them was recorded by any sensor.
    """
    view = held_out_view(recording, frames)
    if view is None:
        raise ValueError(f"expected a recorded frame among {list(frames)} of scene {store.scene}, found none")
    return Judge(recording=recording, view=view, store=store)


def shrunk_images(recording: Recording, divisor: int) -> Recording:
    """The recording with training images `divisor` times smaller a side, pixels' means."""
    if divisor == 1:
        return recording
    cameras = {}
    for name, camera in recording.cameras.items():
        images = camera.training
        rgb = np.stack([block_colours(image, divisor) for image in images.rgb])
        valid = block_means(images.valid, divisor) == 1.0
        pinhole = shrunk(images.pinhole, divisor)
        training = CameraImages(pinhole, rgb, images.pose, np.flatnonzero(valid.reshape(-1)))
        cameras[name] = replace(camera, training=training)
    return replace(recording, cameras=cameras)


def samples_a_ray(judge: Judge, recipe: Recipe | None) -> float | None:
    """Points that are looked at along a LiDAR ray of what stands, on average; None = of `reproject`."""
    if isinstance(recipe, PaperRecipe):
        return float(recipe.sampling.samples)
    lidar, plan = judge.recording.lidar, judge.view.sweeps
    if lidar is None or plan is None:
        return None
    spec = recipe.evidence if isinstance(recipe, ResidualRecipe) else EvidenceSpec()
    rays = quarter_of_rays(lidar, plan, float(plan.time_s[0]), spec.votes)
    batch = surface_batch(
        lidar.evidence.static, rays.origin_m, rays.direction, most=spec.lidar_candidates, near_m=NEAR_M,
        far_m=lidar.far_m,
    )  # fmt: skip
    return float(batch.is_there.sum(dim=1).float().mean())


def thinned(images: np.ndarray) -> np.ndarray:
    """Every fourth pixel of every fourth row of images (n, h, w, ...)."""
    first = _PIXEL_STEP // 2
    return images[:, first::_PIXEL_STEP, first::_PIXEL_STEP]


def thin_pinhole(pinhole: Pinhole) -> Pinhole:
    """The camera whose pixels are exactly those that `thinned` keeps."""
    first, step = _PIXEL_STEP // 2, _PIXEL_STEP
    return Pinhole(
        fx=pinhole.fx / step, fy=pinhole.fy / step, cx=(pinhole.cx - first) / step,
        cy=(pinhole.cy - first) / step, width=len(range(first, pinhole.width, step)),
        height=len(range(first, pinhole.height, step)),
    )  # fmt: skip
