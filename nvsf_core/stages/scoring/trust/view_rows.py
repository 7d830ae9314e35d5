"""Rows of the protocol `trust`: each view's cues and score, frame by frame, and the band of recorded data."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from nvsf_core.metrics.measure import Measure, absent
from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.metrics.trust.cues import BAND, GUESSED, IMAGE_CUES, ODOMETRY, PROTOCOL, SCAN_CUES, SCORE
from nvsf_core.metrics.trust.verdict import LIDAR, Band, score_of
from nvsf_core.recording.drive import Sweeps
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.scoring.rows import Ledger
from nvsf_core.stages.scoring.trust.images import RecordedCamera, image_cues
from nvsf_core.stages.scoring.trust.odometry import odometry_errors
from nvsf_core.stages.scoring.trust.scans import read_training_scans, scan_cues
from nvsf_core.stores.arrays import holds_array, read_attrs

_ABSENT = absent("too little recorded is left over to compare with, or it was recorded by another sensor")
_Cues = Iterator[tuple[int, Mapping[str, float]]]


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSensor:
    """A sensor of the drive, what its views are compared with, and how far recorded data are apart."""

    name: str
    """`lidar`, or the camera's name."""
    cues_of: Callable[[Path], _Cues]
    """Frame and cues of each scan or image in the Zarr group of a view."""
    band: Mapping[str, Band]
    """Metric to its band; without those that are not known."""
    sweeps: Sweeps | None = None
    """The recorded scans, of a LiDAR."""


def recorded_sensors(task: Task, paths: Sequence[Path]) -> list[RecordedSensor]:
    """The drive's sensors whose views can be compared; what none of the model's views shows is not read."""
    found = list[RecordedSensor]()
    scans = read_training_scans(task) if any(shows(path, LIDAR) for path in paths) else None
    if scans is not None:
        task.progress(f"[{task.scene.name}] scene_metrics: how far recorded scans are apart")
        band, asked = _band(scans.band(), LIDAR), {view.name: view.sensor for view in task.scene.views}
        found.append(
            RecordedSensor(LIDAR, partial(scan_cues, recorded=scans, asked=asked), band, scans.sweeps)
        )
    held_out = next((path for path in paths if path.parent.name == HELD_OUT), None)
    shown = {name for path in paths for name in read_attrs(path).get("cameras", [])}
    recorded = read_attrs(task.store.require("undistorted") / "images.zarr")["cameras"]
    # A view's own cameras, of other intrinsics, have recorded nothing.
    for name in sorted(shown & set(recorded)):
        if any(shows(path, name) for path in paths):
            task.progress(f"[{task.scene.name}] scene_metrics: how far recorded images of {name} are apart")
            camera = RecordedCamera(task, name, held_out)
            band = _band(camera.band(), name)
            found.append(RecordedSensor(name, partial(image_cues, camera=camera), band))
    return found


def shows(path: Path, sensor: str) -> bool:
    """Whether the Zarr group of a view has what a verdict on its scans, or a camera's images, needs."""
    needed = ("grid_hit", "grid_support")
    if sensor != LIDAR:
        needed = (f"{sensor}_range_m", f"{sensor}_camera_to_world")
    return all(holds_array(path, name) for name in needed)


def measure_trust(path: Path, sensor: RecordedSensor, ledger: Ledger) -> Iterator[str]:
    """Add the rows of one sensor of a view; yields progress after each scan or image."""
    view, first = path.parent.name, -1
    cues_of_kind = SCAN_CUES if sensor.name == LIDAR else IMAGE_CUES
    wanted = [SCORE, GUESSED, *(cue.name for cue in cues_of_kind if cue != ODOMETRY)]
    for frame, cues in sensor.cues_of(path):
        values = {**cues, SCORE: score_of(cues, sensor.name)}
        measures = {name: _measure(values.get(name, math.nan)) for name in wanted}
        _add(ledger, measures, view, sensor.name, "all", frame)
        first = frame if first < 0 else first
        yield f"trust, frame {frame}"
    if first < 0:
        return
    for region in BAND:
        one = region.removeprefix("recorded_")
        measures = {name: _measure(getattr(band, one)) for name, band in sensor.band.items()}
        _add(ledger, measures, view, sensor.name, region, first)
    if sensor.sweeps is not None:
        mine, recorded = odometry_errors(path, sensor.sweeps)
        _add(ledger, {ODOMETRY.name: mine}, view, sensor.name, "all", first)
        for region in BAND if not recorded.reason else ():
            _add(ledger, {ODOMETRY.name: recorded}, view, sensor.name, region, first)
        yield "trust, odometry"


def _add(
    ledger: Ledger, measures: Mapping[str, Measure], view: str, sensor: str, region: str, frame: int
) -> None:
    ledger.add(
        measures, split=view, protocol=PROTOCOL, region=region, sensor=sensor, frame=frame,
        render_seconds=math.nan,
    )  # fmt: skip


def _measure(value: float) -> Measure:
    return Measure(value, 1) if math.isfinite(value) else _ABSENT


def _band(recorded: Sequence[Mapping[str, float]], sensor: str) -> dict[str, Band]:
    """Bands of the cues, and of the score, of recorded scans or images."""
    values: dict[str, list[float]] = {}
    for cues in recorded:
        for name, value in {**cues, SCORE: score_of(cues, sensor)}.items():
            values.setdefault(name, []).append(value)
    found = {name: Band.of(some) for name, some in values.items()}
    return {name: band for name, band in found.items() if band is not None}
