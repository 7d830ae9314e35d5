"""Stage `sweeps`: every return with its laser, firing, time, and motion-compensated ray in the scene."""

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from nvsf_core.clouds.map_thickness import map_thickness_m
from nvsf_core.drives.drive import drive_of
from nvsf_core.drives.kitti360.scans import Scan
from nvsf_core.errors import DataError
from nvsf_core.geometry.se3 import poses_in
from nvsf_core.reporting.previews import scan_top_view
from nvsf_core.sensors.bonnet import ScanReturns, fit_bonnet
from nvsf_core.sensors.found_table import FoundTable, find_table
from nvsf_core.sensors.lasers import FILE_ORDER, UNKNOWN, is_unlike
from nvsf_core.sensors.own_vehicle import OwnVehicle, PlacedScan, learn_own_vehicle
from nvsf_core.sensors.scan_timing import RING, ScanTiming, scan_timing
from nvsf_core.sensors.sensor_errors import learn_intensity_gain, learn_range_bias
from nvsf_core.sensors.sweep import Trajectory, compensate, trajectory_of
from nvsf_core.sensors.tables import ATTRIBUTE, HDL_64E, SENSOR_TABLES, LaserTable, sensor_table, table_facts
from nvsf_core.stages.inputs import scene_frame
from nvsf_core.stages.runner.heartbeat import sparse
from nvsf_core.stages.runner.stage import Check, StageOutput, Task
from nvsf_core.stores.arrays import write_arrays
from nvsf_core.stores.documents import read_document
from nvsf_core.stores.tables import read_rows

ARRAYS_NAME = "returns.zarr"
SENSOR = HDL_64E
"""The sensor of KITTI and KITTI-360."""

_OWN_VEHICLE_CELLS = 2000
_FINDING_SCANS = 5
"""Scans that an unknown sensor's lasers are found from."""
_MOST_BESIDE_CLOCK = 0.05
"""Share of returns whose times may not follow their azimuth; at the cut, a few do not."""

_Rays = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Origins, directions and ranges of one scan's returns, as `compensate` gives them."""
_MAP_RANGE_M = 40.0
_MAP_RETURNS = 600_000


@dataclass(frozen=True, slots=True, eq=False)
class _Scan:
    """One recorded scan, with the recovered laser, firing and time of its returns."""

    row: dict[str, Any]
    """Its row of `frames.parquet`."""
    points_m: np.ndarray
    """(n, 3) float32, sensor's frame, file order."""
    intensity: np.ndarray
    """(n,) float32, 0..1."""
    timing: ScanTiming


def run(task: Task) -> StageOutput:
    """Read each scan and place its rays in the world; the stage `sweeps`."""
    frames_dir = task.store.require("frames")
    rows = read_rows(frames_dir / "frames.parquet")
    drive: dict[str, Any] = read_document(frames_dir / "drive.json")
    scene_to_world = scene_frame(drive)
    posed = [row for row in rows if row["pose_valid"]]
    table, found, scans = _read_scans(task, [row for row in posed if row["scan_valid"]], drive)
    sources = Counter(scan.timing.source for scan in scans)
    source = sources.most_common(1)[0][0] if scans else UNKNOWN
    correction_rad = 0.0 if source == UNKNOWN else table.elevation_correction_rad
    # A period of 0 puts a whole scan at its pose's instant, as the papers do.
    period_s = drive["sweep_period_s"] if task.scene.is_to_compensate else 0.0
    # All posed frames, held-out ones and those without a scan too: motion is interpolated between poses.
    rays = _placed(task, table, scans, trajectory_of(posed, scene_to_world), period_s, correction_rad)
    arrays = _arrays(scans, rays, _learn_own_vehicle(table, scans, rays, scene_to_world))
    arrays |= _recorded_times(scans)
    arrays |= _mirrored(table, scans)
    arrays |= _laser_errors(table, scans, arrays)
    evidence = found + _evidence(scans, sources)
    attrs = {
        "scene_to_world": drive["scene_to_world"],
        "sweep_period_s": drive["sweep_period_s"],
        "elevation_correction_deg": float(np.rad2deg(correction_rad)),
        "laser_source": source,
        "laser_evidence": evidence,
        "lasers": np.unique(arrays["laser"][arrays["laser"] >= 0]).tolist(),
        "compensated": task.scene.is_to_compensate,
        "sensor": table.name,
    }
    if table.name not in SENSOR_TABLES:
        attrs[ATTRIBUTE] = table_facts(table)
    write_arrays(task.folder / ARRAYS_NAME, arrays, attrs)
    return _output(task, table, scans, arrays, attrs, drive)


def _read_scans(
    task: Task, rows: list[dict[str, Any]], drive: dict[str, Any]
) -> tuple[LaserTable, str, list[_Scan]]:
    """The sensor's table, how it was found (empty for a known one), and the scans."""
    source = drive_of(task.scene)
    read: list[Scan] = []
    say = sparse(task.progress)
    for row in rows:
        read.append(source.read_scan(row["frame"], row["checksum"]))
        say(f"[{task.scene.name}] sweeps: read {len(read)} of {len(rows)} scans")
    training = [one for row, one in zip(rows, read, strict=True) if row["split"] == "train"]
    try:
        table, found = _table(drive.get("sensor", SENSOR.name), training, task.scene.is_lidar_assumed)
    except DataError as error:
        others = source.other_scans()
        raise DataError(f"{error}; {others}" if others else str(error)) from error
    period_s = float(drive["sweep_period_s"])
    scans = []
    for row, one in zip(rows, read, strict=True):
        points_m = np.ascontiguousarray(one.points[:, :3])
        timing = scan_timing(points_m, table, ring=one.ring, offset_s=one.offset_s, period_s=period_s)
        scans.append(_Scan(row, points_m, one.points[:, 3].copy(), timing))
    return table, found, scans


def _table(sensor: str, scans: list[Scan], is_assumed: bool) -> tuple[LaserTable, str]:
    """The table of the sensor of that name, or found from some training scans, with the evidence."""
    if sensor == SENSOR.name or not scans:
        return _of_another(scans) if is_assumed else (SENSOR, "")
    if sensor in SENSOR_TABLES:
        return sensor_table(sensor), ""
    made = _found(scans)
    return made.table, f"found from the scans: {made.evidence}; "


def _of_another(scans: list[Scan]) -> tuple[LaserTable, str]:
    """The assumed sensor's table, or a found one where most of the scans are not of that sensor."""
    if not is_unlike(SENSOR, [one.points[:, :3] for one in scans[_finding(scans)]]):
        return SENSOR, ""
    try:
        made = _found(scans)
    except DataError:
        return SENSOR, ""  # the check `lasers_are_known` says that they are not
    return made.table, f"not of an {SENSOR.name}, found from the scans: {made.evidence}; "


def _found(scans: list[Scan]) -> FoundTable:
    """The table found from some of the scans; the others are asked where a ring has few returns."""
    points = [(one.points[:, :3], one.ring) for one in scans]
    chosen = range(len(scans))[_finding(scans)]
    return find_table([points[k] for k in chosen], [one for k, one in enumerate(points) if k not in chosen])


def _finding(scans: list[Scan]) -> slice:
    """Which scans lasers are found from."""
    step = max(1, len(scans) // _FINDING_SCANS)
    return slice(0, step * _FINDING_SCANS, step)


def _placed(
    task: Task,
    table: LaserTable,
    scans: list[_Scan],
    trajectory: Trajectory,
    period_s: float,
    correction_rad: float,
) -> list[_Rays]:
    """The scans' returns as rays in the scene, compensated for ego-motion."""
    say = sparse(task.progress)
    rays: list[_Rays] = []
    for scan in scans:
        time_s = scan.row["time_s"] + scan.timing.elapsed * period_s
        rays.append(
            compensate(
                table, scan.points_m, scan.timing.laser, time_s, trajectory,
                elevation_correction_rad=correction_rad,
            )
        )  # fmt: skip
        say(f"[{task.scene.name}] sweeps: moved {len(rays)} of {len(scans)} scans")
    return rays


def _learn_own_vehicle(
    table: LaserTable, scans: list[_Scan], rays: list[_Rays], scene_to_world: np.ndarray
) -> OwnVehicle:
    training = [(one, ray) for one, ray in zip(scans, rays, strict=True) if one.row["split"] == "train"]
    firings = [scan.timing.firings for scan, _ in training if scan.timing.firings > 0]
    # Cells finer than the firings would be empty by chance and miss the car.
    cells = min(_OWN_VEHICLE_CELLS, min(firings, default=_OWN_VEHICLE_CELLS))
    poses = poses_in(scene_to_world, _poses([scan for scan, _ in training]))
    placed = [
        PlacedScan(
            points_m=scan.points_m, intensity=scan.intensity, laser=scan.timing.laser,
            world_m=(origin_m + direction * range_m[:, None]).astype(np.float32),
            position_m=pose[:3, 3],
        )
        for (scan, (origin_m, direction, range_m)), pose in zip(training, poses, strict=True)
    ]  # fmt: skip
    return learn_own_vehicle(table, placed, cells)


def _mirrored(table: LaserTable, scans: list[_Scan]) -> dict[str, np.ndarray]:
    """The bonnet, learned from training scans, and which returns of all scans it mirrored."""
    returns = [ScanReturns(scan.points_m, scan.timing.laser) for scan in scans]
    is_training = [scan.row["split"] == "train" for scan in scans]
    bonnet = fit_bonnet(table, [one for one, is_used in zip(returns, is_training, strict=True) if is_used])
    if bonnet is None:
        return {"is_mirrored": np.zeros(sum(len(one.laser) for one in returns), np.bool_)}
    mirrored = [bonnet.is_mirrored(table, one) for one in returns]
    return {"is_mirrored": _joined(mirrored, np.bool_), "bonnet_shape": bonnet.shape}


def _arrays(scans: list[_Scan], rays: list[_Rays], own: OwnVehicle) -> dict[str, np.ndarray]:
    counts = [len(scan.points_m) for scan in scans]
    return {
        "frame": np.array([scan.row["frame"] for scan in scans], np.int64),
        "time_s": np.array([scan.row["time_s"] for scan in scans], np.float64),
        "lidar_to_world": _poses(scans),
        "firings": np.array([scan.timing.firings for scan in scans], np.int32),
        "offsets": np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        "points_m": _joined([scan.points_m for scan in scans], np.float32, 3),
        "intensity": _joined([scan.intensity for scan in scans], np.float32),
        "laser": _joined([scan.timing.laser for scan in scans], np.int16),
        "firing": _joined([scan.timing.firing for scan in scans], np.int16),
        "sweep_fraction": _joined([scan.timing.sweep_fraction for scan in scans], np.float32),
        "origin_m": _joined([ray[0] for ray in rays], np.float32, 3),
        "direction": _joined([ray[1] for ray in rays], np.float32, 3),
        "range_m": _joined([ray[2] for ray in rays], np.float32),
        "is_own_vehicle": _joined([own.is_own(scan.points_m) for scan in scans], np.bool_),
        "own_vehicle_range_m": own.range_m,
        "own_vehicle_intensity": own.intensity,
    }


def _recorded_times(scans: list[_Scan]) -> dict[str, np.ndarray]:
    """When returns were measured and the scans' clocks; nothing where their azimuths tell all of it."""
    if all(np.array_equal(scan.timing.elapsed, scan.timing.sweep_fraction) for scan in scans):
        return {}
    return {
        "elapsed": _joined([scan.timing.elapsed for scan in scans], np.float32),
        "sweep_clock": np.array([scan.timing.clock for scan in scans], np.float64),
    }


def _poses(scans: list[_Scan]) -> np.ndarray:
    """(n, 4, 4) float64 poses of the scans in the world."""
    return np.array([scan.row["lidar_to_world"] for scan in scans], np.float64).reshape(-1, 4, 4)


def _joined(parts: list[np.ndarray], dtype: type, columns: int = 0) -> np.ndarray:
    empty: np.ndarray = np.zeros((0, columns) if columns else (0,), dtype)
    return np.concatenate([empty, *[part.astype(dtype) for part in parts]])


def _evidence(scans: list[_Scan], sources: Counter[str]) -> str:
    if not scans:
        return "no scans"
    firings = [scan.timing.firings for scan in scans]
    counts = ", ".join(f"{source} in {count} scans" for source, count in sources.items())
    first = scans[0]
    return (
        f"{counts}; {min(firings)} to {max(firings)} firings a sweep; "
        f"frame {first.row['frame']}: {first.timing.evidence}"
    )


def _laser_errors(
    table: LaserTable, scans: list[_Scan], arrays: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Range bias and intensity gain of each laser, learned from training scans; all ranges without bias."""
    of_training = np.repeat([scan.row["split"] == "train" for scan in scans], np.diff(arrays["offsets"]))
    used = np.flatnonzero(of_training.astype(np.bool_) & ~arrays["is_own_vehicle"] & ~arrays["is_mirrored"])
    bias_m = learn_range_bias(
        arrays["origin_m"][used], arrays["direction"][used], arrays["range_m"][used], arrays["laser"][used],
        table.laser_count,
    )  # fmt: skip
    own_m = np.where(arrays["laser"] >= 0, bias_m[arrays["laser"]], 0.0)
    range_m = np.maximum(arrays["range_m"] - own_m, 0.0).astype(np.float32)
    points_m = arrays["origin_m"][used] + arrays["direction"][used] * range_m[used, None]
    gain = learn_intensity_gain(points_m, arrays["intensity"][used], arrays["laser"][used], table.laser_count)
    return {"laser_range_bias_m": bias_m, "laser_intensity_gain": gain, "range_m": range_m}


def _thickness(arrays: dict[str, np.ndarray]) -> float:
    """Thickness of the map of all scans, metres; thinned evenly, without the own vehicle."""
    part = slice(None, None, max(1, len(arrays["range_m"]) // _MAP_RETURNS))
    kept = (arrays["range_m"][part] < _MAP_RANGE_M) & ~arrays["is_own_vehicle"][part]
    range_m = arrays["range_m"][part][kept, None].astype(np.float64)
    points_m = arrays["origin_m"][part][kept] + range_m * arrays["direction"][part][kept]
    return map_thickness_m(points_m)


def _output(
    task: Task,
    table: LaserTable,
    scans: list[_Scan],
    arrays: dict[str, np.ndarray],
    attrs: dict[str, Any],
    drive: dict[str, Any],
) -> StageOutput:
    if not scans:
        check = Check(name="drive_has_scans", passed=True, detail="camera-only drive: no valid scan")
        return StageOutput(metadata={"scans": 0, "returns": 0}, checks=[check])
    own_per_scan = arrays["is_own_vehicle"].sum() / len(scans)
    output = StageOutput(
        metadata={
            "scans": len(scans),
            "returns": len(arrays["laser"]),
            "firings_min": int(arrays["firings"].min()),
            "firings_max": int(arrays["firings"].max()),
            "laser_source": attrs["laser_source"],
            "laser_evidence": attrs["laser_evidence"],
            "own_vehicle_returns_per_scan": float(own_per_scan),
            "mirrored_returns_per_scan": float(arrays["is_mirrored"].sum() / len(scans)),
            "map_thickness_m": _thickness(arrays),
            "compensated": attrs["compensated"],
            "sweep_period_s": drive["sweep_period_s"],
            "sweep_period_assumed": bool(drive["period_assumed"]),
            "elevation_correction_deg": attrs["elevation_correction_deg"],
            "laser_range_bias_rms_m": float(np.sqrt(np.mean(arrays["laser_range_bias_m"] ** 2))),
            "laser_range_bias_max_m": float(np.abs(arrays["laser_range_bias_m"]).max()),
            "laser_intensity_gain_min": float(arrays["laser_intensity_gain"].min()),
            "laser_intensity_gain_max": float(arrays["laser_intensity_gain"].max()),
        },
        checks=_checks(scans, arrays, attrs, table),
    )
    middle = scans[len(scans) // 2]
    (task.folder / "scan.png").write_bytes(scan_top_view(middle.points_m))
    output.previews["scan"] = "scan.png"
    return output


def _checks(
    scans: list[_Scan], arrays: dict[str, np.ndarray], attrs: dict[str, Any], table: LaserTable
) -> list[Check]:
    finite = all(bool(np.isfinite(arrays[name]).all()) for name in ("origin_m", "direction", "range_m"))
    length_error = float(np.abs(np.linalg.norm(arrays["direction"], axis=1) - 1.0).max())
    unknown = int((arrays["laser"] < 0).sum())
    homeless = int(((arrays["laser"] >= 0) & (arrays["firing"] < 0)).sum())
    dull = [scan.row["frame"] for scan in scans if np.ptp(scan.intensity) == 0.0]
    shared = sum(_shared_cells(scan.timing, table.laser_count) for scan in scans)
    ordered = sum(scan.timing.source in (FILE_ORDER, RING) for scan in scans)
    apart = float(np.mean([scan.timing.share_beside_clock for scan in scans]))
    return [
        Check(
            name="every_return_has_a_ray", passed=finite and length_error < 1e-5, blocking=True,
            detail=f"rays finite: {finite}; directions off unit length by at most {length_error:.1e}",
        ),
        Check(
            name="lasers_are_known", passed=unknown == 0,
            detail=f"{unknown} of {len(arrays['laser'])} returns without a laser; {attrs['laser_evidence']}",
        ),
        Check(
            name="times_follow_the_azimuth", passed=apart <= _MOST_BESIDE_CLOCK,
            detail=f"{apart:.1%} of the returns have times that are not a spinning sensor's: what scans "
            "recorded beside a ray, and what moves, is looked up by azimuth, and wrong for them; correct the "
            "times, or leave them out",
        ),
        Check(
            name="scans_are_in_file_order", passed=ordered == len(scans),
            detail=f"{ordered} of {len(scans)} scans hold laser after laser, or say which",
        ),
        Check(
            name="intensities_are_recorded", passed=not dull,
            detail=f"{len(dull)} of {len(scans)} scans with one intensity throughout{_named(dull)}",
        ),
        Check(
            name="firings_are_known", passed=homeless == 0,
            detail=f"{homeless} of {len(arrays['laser'])} returns of known lasers without a firing",
        ),
        Check(
            name="no_two_returns_share_a_firing", passed=shared <= 1e-4 * len(arrays["laser"]),
            detail=f"{shared} of {len(arrays['laser'])} returns share laser and firing with another",
        ),
    ]  # fmt: skip


def _named(frames: list[int]) -> str:
    shown = ", ".join(map(str, frames[:5]))
    return f": frames {shown}{', ...' if len(frames) > 5 else ''}" if frames else ""


def _shared_cells(timing: ScanTiming, laser_count: int) -> int:
    known = (timing.laser >= 0) & (timing.firing >= 0)
    cell = timing.firing[known].astype(np.int64) * laser_count + timing.laser[known]
    return len(cell) - len(np.unique(cell))
