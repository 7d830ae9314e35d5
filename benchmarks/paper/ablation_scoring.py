"""What the ablation is scored by: every fourth pano column, and images at a quarter of width and height."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from benchmarks.paper.ablation_table import Row
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.metrics.foreground import lidar4d_regions
from nvsf_core.metrics.image import image_metrics
from nvsf_core.metrics.measure import Measure
from nvsf_core.metrics.protocols import PanoImage, Scan, lidar4d, project_scan
from nvsf_core.models.paper.training.frames import PaperFrames
from nvsf_core.recording.drive import Recording
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.stages.runner.run import SceneRun
from nvsf_core.stages.scoring.moving_boxes import MovingBoxes

COLUMN_STEP, IMAGE_STEP = 4, 4
LIDAR_METRICS = (
    "chamfer_m2", "f_score", "range_rmse_m", "range_psnr_db", "range_ssim", "intensity_rmse", "hit_rmse",
)  # fmt: skip
IMAGE_METRICS = ("image_psnr_db", "image_ssim")


class SparsePano(LinearPano):
    """Every fourth column of the pano."""

    def directions(self) -> np.ndarray:
        """(66, 258, 3) unit directions."""
        return super().directions()[:, ::COLUMN_STEP]

    def points(self, range_m: np.ndarray) -> np.ndarray:
        """Points of the filled cells of an image (66, 258)."""
        filled = range_m > 0.0
        found: np.ndarray = self.directions()[filled] * range_m[filled, None].astype(np.float64)
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """What all runs of a scene share."""

    run: SceneRun
    recording: Recording
    frames: PaperFrames
    boxes: MovingBoxes | None


Scored = Iterable[tuple[str, Mapping[str, Measure]]]
"""Region and metrics of a frame and a sensor."""


def sparse(pano: PanoImage) -> PanoImage:
    """Every fourth column of a whole pano."""
    return PanoImage(
        **{name: getattr(pano, name)[:, ::COLUMN_STEP] for name in ("range_m", "intensity", "hit")}
    )


def score_pano(scene: Scene, frame: int, predicted: PanoImage) -> Iterator[tuple[str, Mapping[str, Measure]]]:
    """A sparse pano against the recorded scan of its frame."""
    lidar = scene.recording.lidar
    assert lidar is not None
    a = lidar.sweeps.arrays
    part = lidar.sweeps.returns_of(int(np.flatnonzero(a["frame"] == frame)[0]))
    scan = Scan(points_m=a["points_m"][part], intensity=a["intensity"][part], laser=a["laser"][part])
    truth = sparse(project_scan(LinearPano(reference_quirks=True), scan))
    yield "all", lidar4d(predicted, truth, SparsePano(), None)
    if scene.boxes is not None:
        regions = lidar4d_regions(predicted, truth, SparsePano(), scene.boxes.in_lidar(frame), None)
        yield "foreground", regions["foreground"]


def score_image(shown: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> Mapping[str, Measure]:
    """A small image (h, w, 3) uint8 against a recorded (H, W, 3) uint8, where all of `valid` (H, W) is."""
    seen = averaged(valid.astype(np.float64)) == 1.0
    return image_metrics(shown, averaged_rgb(truth), seen, None)


def rows_of(scored: Scored, scene: str, variant: str, seed: int) -> list[Row]:
    """The means over frames and cameras where a metric is defined."""
    values: dict[tuple[str, str], list[float]] = {}
    for region, measures in scored:
        for metric, measure in measures.items():
            if metric in LIDAR_METRICS + IMAGE_METRICS and measure.n_valid:
                values.setdefault((region, metric), []).append(measure.value)

    def row(region: str, metric: str, value: float) -> Row:
        known = value if np.isfinite(value) else None
        return Row(variant=variant, scene=scene, seed=seed, region=region, metric=metric, value=known)

    return [row(region, metric, float(np.mean(found))) for (region, metric), found in values.items()]


def quarter(camera: Pinhole) -> Pinhole:
    """The camera whose pixels are the means of 4 x 4 of this one's; centres lie on whole numbers."""
    half = (IMAGE_STEP - 1) / 2.0
    return Pinhole(
        fx=camera.fx / IMAGE_STEP, fy=camera.fy / IMAGE_STEP, cx=(camera.cx - half) / IMAGE_STEP,
        cy=(camera.cy - half) / IMAGE_STEP, width=camera.width // IMAGE_STEP,
        height=camera.height // IMAGE_STEP,
    )  # fmt: skip


def averaged_rgb(image: np.ndarray) -> np.ndarray:
    """The same of an image (H, W, 3), as (h, w, 3) uint8."""
    return np.rint(averaged(image.astype(np.float64))).astype(np.uint8)


def averaged(image: np.ndarray) -> np.ndarray:
    """Means of 4 x 4 pixels; a rest at the right and lower edge is left out."""
    height, width = (side // IMAGE_STEP for side in image.shape[:2])
    cut = image[: height * IMAGE_STEP, : width * IMAGE_STEP]
    found: np.ndarray = cut.reshape(height, IMAGE_STEP, width, IMAGE_STEP, *image.shape[2:]).mean(axis=(1, 3))
    return found
