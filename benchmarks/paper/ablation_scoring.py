"""Scores of the ablation: on every fourth pano column, and on images at a quarter of width and height.

A baseline is scored by the held-out views of the scene that were published last, thinned alike.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.compared import QuarterPano, block_colours, block_means, recorded_scan
from benchmarks.common.documents import Row
from nvsf_core.errors import DataError
from nvsf_core.metrics.foreground import lidar4d_regions
from nvsf_core.metrics.image import image_metrics
from nvsf_core.metrics.measure import Measure
from nvsf_core.metrics.protocols import PanoImage, lidar4d, project_scan
from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.models.paper.training_frames import PaperFrames
from nvsf_core.recording.drive import Recording
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.stages.runner.run import SceneRun
from nvsf_core.stages.scoring.moving_boxes import MovingBoxes
from nvsf_core.stores.arrays import read_arrays
from nvsf_core.stores.scene_store import SceneStore

IMAGE_STEP = 4
METRICS = (
    "chamfer_m2", "f_score", "range_rmse_m", "range_psnr_db", "range_ssim", "intensity_rmse", "hit_rmse",
    "image_psnr_db", "image_ssim",
)  # fmt: skip
_SPARSE = QuarterPano()

Scored = Iterable[tuple[str, Mapping[str, Measure]]]
"""Region and metrics of a frame and a sensor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """What all runs of a scene share."""

    run: SceneRun
    recording: Recording
    frames: PaperFrames
    boxes: MovingBoxes | None


def score_pano(scene: Scene, frame: int, predicted: PanoImage) -> Iterator[tuple[str, Mapping[str, Measure]]]:
    """A pano of every fourth column against the recorded scan of its frame."""
    assert scene.recording.lidar is not None
    scan = recorded_scan(scene.recording.lidar, frame)
    truth = _SPARSE.cut(project_scan(LinearPano(reference_quirks=True), scan))
    yield "all", lidar4d(predicted, truth, _SPARSE, None)
    if scene.boxes is not None:
        regions = lidar4d_regions(predicted, truth, _SPARSE, scene.boxes.in_lidar(frame), None)
        yield "foreground", regions["foreground"]


def score_images(
    scene: Scene, camera: str, shown: Iterable[tuple[int, np.ndarray]]
) -> Iterator[tuple[str, Mapping[str, Measure]]]:
    """Frames and small images of a camera against what it recorded."""
    folder = scene.run.store.require("undistorted") / "images.zarr"
    keys = [f"{camera}_{part}" for part in ("rgb", "valid", "frame")]
    rgb, valid, frames = (read_arrays(folder, *keys)[key] for key in keys)
    for frame, image in shown:
        yield "all", score_image(image, rgb[frames == frame][0], valid)


def score_image(shown: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> Mapping[str, Measure]:
    """A small image (h, w, 3) uint8 against a recorded (H, W, 3) uint8, where all of `valid` (H, W) is."""
    seen = block_means(valid, IMAGE_STEP) == 1.0
    return image_metrics(shown, block_colours(truth, IMAGE_STEP), seen, None)


def rows_of(scored: Scored, scene: str, variant: str, seed: int) -> list[Row]:
    """A row a metric and region: the mean over frames and cameras where it is defined, None where nowhere."""
    values: dict[tuple[str, str], list[float]] = {}
    for region, measures in scored:
        for metric, measure in measures.items():
            if metric in METRICS and measure.n_valid:
                values.setdefault((region, metric), []).append(measure.value)
    means = {place: float(np.mean(found)) for place, found in values.items()}
    return [
        {
            "variant": variant, "scene": scene, "seed": seed, "region": region, "metric": metric,
            "value": mean if np.isfinite(mean) else None,
        }
        for (region, metric), mean in means.items()
    ]  # fmt: skip


def baseline_rows(scene: Scene, name: str) -> list[Row]:
    """A baseline's errors; it has no seed, and learned nothing.

    Raises:
        DataError: No view of the scene is published, or none by this baseline.
    """
    views = _newest_views(scene.run.store, name)
    return rows_of(_scored_views(scene, views), scene.run.scene.name, name, 0)


def _newest_views(store: SceneStore, name: str) -> Path:
    """The arrays of a baseline's held-out views, whatever recipe they were published beside."""
    # A killed writer leaves hidden folders behind.
    found = store.path("novel_views").glob(f"[!.]*/[!.]*/{HELD_OUT}/{name}.zarr")
    newest = max(found, key=lambda path: path.stat().st_mtime_ns, default=None)
    if newest is None:
        raise DataError(
            f"{store.path('novel_views')}: expected held-out views by {name}, found none; "
            f"make train SCENES={store.scene} RECIPE=quick publishes them"
        )
    return newest


def _scored_views(scene: Scene, views: Path) -> Scored:
    panos = ("pano_range_m", "pano_intensity", "pano_hit")
    a = read_arrays(views, "frame", *panos)
    for row, frame in enumerate(a["frame"].tolist()):
        range_m, intensity, hit = (a[key][row] for key in panos)
        pano = PanoImage(range_m=range_m, intensity=intensity, hit=hit)
        yield from score_pano(scene, frame, _SPARSE.cut(pano))
    for camera in scene.recording.cameras:
        shown = read_arrays(views, f"{camera}_rgb", f"{camera}_frame")
        images = (block_colours(image, IMAGE_STEP) for image in shown[f"{camera}_rgb"])
        yield from score_images(scene, camera, zip(shown[f"{camera}_frame"].tolist(), images, strict=True))
