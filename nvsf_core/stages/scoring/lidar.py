"""Metrics of held-out scans against recorded ones, under every LiDAR protocol."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nvsf_core.errors import StoreError
from nvsf_core.geometry.se3 import transform_points
from nvsf_core.metrics.foreground import lidar4d_regions, masked_range_regions, masked_regions
from nvsf_core.metrics.hit import hit_columns
from nvsf_core.metrics.lpips import Lpips
from nvsf_core.metrics.measure import Measure, absent
from nvsf_core.metrics.protocols import PanoImage, RenderedRays, Scan, lidar4d, project_scan, raw
from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.stages.inputs import scene_frame
from nvsf_core.stages.scoring.moving_boxes import MovingBoxes
from nvsf_core.stages.scoring.rows import Ledger
from nvsf_core.stores.arrays import read_arrays, read_attrs, read_part

_RECORDED = ("frame", "offsets", "points_m", "intensity", "laser", "range_m", "firings")
_PREDICTED = (
    "frame", "offsets", "points_m", "intensity", "laser", "pano_range_m", "pano_intensity", "pano_hit",
    "ray_offsets", "ray_range_m", "ray_intensity", "lidar_render_seconds",
)  # fmt: skip
_NO_INTENSITY = absent("no return of the recorded scan has an intensity above 0")


@dataclass(frozen=True, slots=True)
class RecordedScans:
    """The recorded scans, by frame."""

    path: Path
    arrays: dict[str, np.ndarray]
    hit_shape: tuple[int, int]
    """Lasers and columns of the grid of hits."""

    def scan(self, frame: int) -> tuple[Scan, RenderedRays]:
        """The recorded scan of a frame, and range and intensity along its rays.

        Raises:
            StoreError: The frame has no valid recorded scan.
        """
        a, cut = self.arrays, self._part(frame)
        scan = Scan(points_m=a["points_m"][cut], intensity=a["intensity"][cut], laser=a["laser"][cut])
        return scan, RenderedRays(range_m=a["range_m"][cut], intensity=a["intensity"][cut])

    def world_points(self, frame: int) -> np.ndarray:
        """(N, 3) float64 returns of a frame in the world, metres, each along its motion-compensated ray."""
        cut = self._part(frame)
        rays = read_part(self.path, cut, "origin_m", "direction")
        along = rays["direction"].astype(np.float64) * self.arrays["range_m"][cut, None]
        return transform_points(scene_frame(read_attrs(self.path)), along + rays["origin_m"])

    def _part(self, frame: int) -> slice:
        found = np.flatnonzero(self.arrays["frame"] == frame)
        if found.size != 1:
            raise StoreError(
                f"frame {frame} is rendered in the view {HELD_OUT!r}, but {self.path} holds it "
                f"{found.size} times; run novel_views again"
            )
        return part(self.arrays["offsets"], int(found[0]))


def read_recorded_scans(path: Path) -> RecordedScans | None:
    """The recorded scans; None for a drive without a LiDAR."""
    if not path.is_dir() or read_arrays(path, "frame")["frame"].size == 0:
        return None
    arrays = read_arrays(path, *_RECORDED)
    lasers = int(arrays["laser"].max()) + 1 if arrays["laser"].size else 0
    return RecordedScans(path, arrays, (lasers, hit_columns(int(arrays["firings"].max()))))


def measure_lidar(
    path: Path,
    recording: RecordedScans,
    boxes: MovingBoxes | None,
    ledger: Ledger,
    lpips: Lpips | None,
) -> Iterator[str]:
    """Add the rows of the LiDAR protocols; yields progress after each frame.

    Args:
        path: Zarr group of one method's held-out view.
        recording: The recorded scans.
        boxes: Boxes of moving objects; None = no rows of regions.
        ledger: Receives the rows.
        lpips: The LPIPS network; None if its weights are absent.
    """
    frames = read_arrays(path, "frame")["frame"]
    if frames.size == 0:
        return
    a = read_arrays(path, *_PREDICTED)
    pano = LinearPano(reference_quirks=True)
    for i, frame in enumerate(frames.tolist()):
        truth, truth_rays = recording.scan(frame)
        own, rays = part(a["offsets"], i), part(a["ray_offsets"], i)
        predicted = Scan(points_m=a["points_m"][own], intensity=a["intensity"][own], laser=a["laser"][own])
        rendered = RenderedRays(range_m=a["ray_range_m"][rays], intensity=a["ray_intensity"][rays])
        image = PanoImage(
            range_m=a["pano_range_m"][i], intensity=a["pano_intensity"][i], hit=a["pano_hit"][i]
        )
        panos = {"lidar4d": image, "lidar4d_scan": project_scan(pano, predicted)}
        true_image = project_scan(pano, truth)
        found: dict[tuple[str, str], Mapping[str, Measure]] = {
            (protocol, "all"): lidar4d(side, true_image, pano, lpips) for protocol, side in panos.items()
        }
        found["raw", "all"] = raw(predicted, rendered, truth, truth_rays, recording.hit_shape)
        if boxes is not None:
            here = boxes.in_lidar(frame)
            for protocol, side in panos.items():
                regions = lidar4d_regions(side, true_image, pano, here, lpips)
                found |= {(protocol, region): measures for region, measures in regions.items()}
            masked = masked_regions(predicted, rendered, truth, truth_rays, recording.hit_shape, here)
            ranges = masked_range_regions(image, true_image, pano, here)
            found |= {("masked", region): {**masked[region], **ranges[region]} for region in masked}
        if truth.intensity.size and not (truth.intensity > 0.0).any():
            found = {place: _without_intensities(measures) for place, measures in found.items()}
        seconds = float(a["lidar_render_seconds"][i])
        for (protocol, region), measures in found.items():
            ledger.add(
                measures, protocol=protocol, region=region, sensor="lidar", frame=frame,
                render_seconds=seconds,
            )  # fmt: skip
        yield f"frame {frame} ({i + 1} of {frames.size})"


def recorded_range_errors(path: Path, recording: RecordedScans) -> tuple[int, np.ndarray, np.ndarray] | None:
    """A method's range errors along the recorded rays of the middle held-out frame.

    Returns:
        The frame, its recorded points (N, 3) in the sensor's frame, and their absolute range errors (N,), in
        metres; an error is infinite if no return was rendered. None if no frame was held out.
    """
    a = read_arrays(path, "frame", "ray_offsets", "ray_range_m")
    if a["frame"].size == 0:
        return None
    row = a["frame"].size // 2
    frame = int(a["frame"][row])
    truth, rays = recording.scan(frame)
    error_m = np.abs(a["ray_range_m"][part(a["ray_offsets"], row)].astype(np.float64) - rays.range_m)
    return frame, truth.points_m, error_m


def _without_intensities(measures: Mapping[str, Measure]) -> dict[str, Measure]:
    """The same of a sensor that records none: a prediction of none is no merit, and its likeness no fault."""
    return {name: _NO_INTENSITY if name.startswith("intensity_") else one for name, one in measures.items()}


def part(offsets: np.ndarray, i: int) -> slice:
    """Slice of scan `i` in a flat array whose scans begin at `offsets` (n + 1,)."""
    return slice(int(offsets[i]), int(offsets[i + 1]))
