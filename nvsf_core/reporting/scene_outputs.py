"""Read from a scene's published outputs what the report shows; absent outputs leave fields empty."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.metrics.table import BASELINES, HELD_OUT, mean_rows
from nvsf_core.names import RESERVED_SCENES, name_fault
from nvsf_core.recipe.seed import is_seed_folder
from nvsf_core.rendering.rendered import Support
from nvsf_core.reporting.error_cloud import ERROR_CLOUD_NAME
from nvsf_core.reporting.measured_against import MeasuredAgainst, measured_against
from nvsf_core.reporting.stage_record import StageRecord, record_of
from nvsf_core.stores.arrays import holds_array, read_arrays, read_attrs
from nvsf_core.stores.documents import foreign, read_picture
from nvsf_core.stores.scene_store import SceneStore, published
from nvsf_core.stores.tables import read_rows, read_table

METHODS = ("model", *BASELINES)
"""Methods whose rendered views are stored, in the order in which they are measured and shown."""
TRUTH_NAME = "truth.zarr"
"""True images of a view, stored in its folder beside the metrics."""
_REGIONS = [support.region for support in Support]
_READ = ("scene_metrics", "field", "novel_views", "pano", "sweeps", "undistorted")


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraPair:
    """Images of one camera at one instant, each (H, W, 3) uint8."""

    camera: str
    frame: int
    truth: np.ndarray | None
    """The recorded image of a held-out frame, or the true image of another view; None if nobody knows it."""
    rendered: dict[str, np.ndarray]
    """By method."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewPictures:
    """One instant of one rendered view."""

    view: str
    frame: int
    sensor: str
    by_images: bool = False
    """Whether images supplied the rays above the recorded lasers."""
    recorded_range_m: np.ndarray | None = None
    """(H, W) range image in metres, 0 = no return; None if the instant was not recorded."""
    rendered_range_m: dict[str, np.ndarray] = field(default_factory=dict)
    """Method to range image (H, W) in metres."""
    recorded_points_m: np.ndarray | None = None
    rendered_points_m: dict[str, np.ndarray] = field(default_factory=dict)
    cameras: list[CameraPair] = field(default_factory=list)
    scan_page: str = ""
    """File, beside the report, that shows its scans in three dimensions; empty = none."""
    strip: bytes | None = None
    """Animated WebP of recorded beside synthetic; None = none."""
    note: str = ""
    """Why one of them is absent that could be expected."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldRun:
    """One trained field (a recipe and a seed) with its metrics and pictures."""

    recipe: str
    seed: int
    commit: str
    """Commit of the code that measured it; empty if there are no rows."""
    machine: str
    """Machine that measured it; empty if unknown."""
    measured: datetime
    """When it was measured, UTC."""
    means: list[dict[str, Any]]
    """Rows of `metrics.table.mean_rows`, baselines included."""
    curve: dict[str, list[Any]]
    """Training curve by column; empty if there is none."""
    pictures: list[ViewPictures]
    by_support: list[dict[str, Any]] = field(default_factory=list)
    """The model's rows of `scene_metrics` by support, frame by frame."""
    error_cloud: bytes | None = None
    """PNG of `error_cloud_png`; only for the newest run."""
    is_comparable: bool = True
    """Whether it was measured at the newest run's held-out frames, against the same recorded data."""
    other_views: frozenset[str] = frozenset()
    """Views with errors that do not compare with the newest run's of the same name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneOutputs:
    """All that the report shows of one scene."""

    name: str
    records: list[StageRecord] = field(default_factory=list)
    runs: list[FieldRun] = field(default_factory=list)
    """Newest first; only the newest has pictures."""
    proven: dict[str, Any] = field(default_factory=dict)
    """Metadata of the stage `evidence`."""
    failure: str | None = None
    """Why its last run failed; outputs of earlier runs may still be shown."""


def measured_scenes(home: Path) -> list[str]:
    """Sorted names of the scenes below `home` that have metrics of any recipe and seed."""
    if not home.is_dir():
        return []
    named = [
        path
        for path in home.iterdir()
        if name_fault(path.name, RESERVED_SCENES) is None and not path.is_symlink()
    ]
    return sorted(path.name for path in named if _metric_tables(path))


def collect_scene(
    home: Path,
    name: str,
    records: Sequence[StageRecord] = (),
    failure: str | None = None,
    *,
    with_pictures: bool = True,
) -> SceneOutputs:
    """Read one scene's metrics, curves and pictures from `<home>/<name>/`.

    Args:
        home: NVSF_HOME.
        name: The scene.
        records: Its stages'.
        failure: Why its last run failed.
        with_pictures: Whether pictures are wanted, which take most of the time.

    Raises:
        StoreError: An output is damaged, a link, or belongs to another scene.
    """
    store = SceneStore(home, name)
    for stage in _READ:
        store.path(stage)  # refuses a link to elsewhere
    root = store.root
    tables = sorted(_metric_tables(root), key=lambda path: -_measured_s(path, records))
    runs: list[FieldRun] = []
    newest: MeasuredAgainst | None = None
    for position, table in enumerate(tables):
        recipe, seed = table.parts[-3], table.parts[-2]
        rows = read_rows(table)
        others = sorted({str(row["scene"]) for row in rows} - {name})
        if others:
            raise foreign(table, f"expected metrics of scene {name!r}, found those of {others[0]!r:.60}")
        curve = root / "field" / recipe / seed / "curve.parquet"
        against = measured_against(records, recipe, seed, rows)
        is_shown = with_pictures and position == 0
        newest = newest or against
        record = record_of(records, "scene_metrics", recipe, seed)
        runs.append(
            FieldRun(
                recipe=recipe,
                seed=int(seed),
                commit=str(rows[0]["commit"]) if rows else "",
                machine="" if record is None else str(record.metadata.get("machine", "")),
                measured=datetime.fromtimestamp(_measured_s(table, records), UTC),
                means=mean_rows(rows),
                by_support=[row for row in rows if row["recipe"] == recipe and row["region"] in _REGIONS],
                curve=read_table(curve) if curve.is_file() else {},
                pictures=_pictures(root, recipe, seed) if is_shown else [],
                error_cloud=read_picture(table.parent / ERROR_CLOUD_NAME) if is_shown else None,
                is_comparable=against.compares_with(newest),
                other_views=against.other_views(newest),
            )
        )
    proven = next((dict(record.metadata) for record in records if record.stage == "evidence"), {})
    return SceneOutputs(name=name, records=list(records), runs=runs, proven=proven, failure=failure)


def method_rows(scene: SceneOutputs) -> list[dict[str, Any]]:
    """All mean rows, each with the `method` name to show and its `run`; baselines of the newest run only.

    What does not compare with the newest run is left out: runs on other held-out frames, and rows of views
    that were other ones under the same name.
    """
    runs = [run for run in scene.runs if run.is_comparable]
    several = len({run.recipe for run in runs}) < len(runs)
    rows: list[dict[str, Any]] = []
    for position, run in enumerate(runs):
        for row in run.means:
            is_baseline = row["recipe"] in BASELINES
            if (is_baseline and position > 0) or row["split"] in run.other_views:
                continue
            label = f"{row['recipe']}, seed {run.seed}" if several and not is_baseline else row["recipe"]
            rows.append({**row, "method": label, "is_baseline": is_baseline, "run": run})
    return rows


def _metric_tables(root: Path) -> list[Path]:
    """Published metric tables; a killed writer's hidden folders are left out."""
    found = published(root, "scene_metrics/*/*/metrics.parquet")
    return [path for path in found if is_seed_folder(path.parent.name)]


def _measured_s(table: Path, records: Sequence[StageRecord]) -> float:
    """When a table of metrics was made, seconds since the epoch; without a record its file's time counts."""
    record = record_of(records, "scene_metrics", *table.parts[-3:-1])
    return table.stat().st_mtime if record is None else record.made_s


def _pictures(root: Path, recipe: str, seed: str) -> list[ViewPictures]:
    views, metrics = (root / stage / recipe / seed for stage in ("novel_views", "scene_metrics"))
    if not views.is_dir():
        return []
    names = sorted(path.parent.name for path in published(views, "*/model.zarr"))
    names.sort(key=lambda name: name != HELD_OUT)
    return [_view_pictures(root, views / name, metrics / name / TRUTH_NAME) for name in names]


def _view_pictures(root: Path, folder: Path, truth: Path) -> ViewPictures:
    """The middle instant of a view, with the recorded data of a held-out frame or the stored true images."""
    attrs = read_attrs(folder / "model.zarr")
    frames = read_arrays(folder / "model.zarr", "frame")["frame"]
    is_test = folder.name == HELD_OUT
    methods = {m: folder / f"{m}.zarr" for m in METHODS if (folder / f"{m}.zarr").is_dir()}
    known = root / "undistorted" / "images.zarr" if is_test else truth
    found = [_camera(known, methods, camera) for camera in attrs.get("cameras", [])]
    cameras = [pair for pair in found if pair is not None]
    sensor = str(attrs.get("sensor", ""))
    if not frames.size or not sensor:
        frame = cameras[0].frame if cameras else 0
        return ViewPictures(view=folder.name, frame=frame, sensor=sensor, cameras=cameras)
    row = len(frames) // 2
    frame = int(frames[row])
    ranges_m, points_m = {}, {}
    for method, path in methods.items():
        if not read_attrs(path).get("sensor"):
            continue  # a baseline that is measured by its images alone
        stored = read_arrays(path, "pano_range_m", "points_m", "offsets")
        ranges_m[method] = stored["pano_range_m"][row]
        points_m[method] = stored["points_m"][stored["offsets"][row] : stored["offsets"][row + 1]]
    recorded_range_m, recorded_points_m = _recorded_scan(root, frame) if is_test else (None, None)
    return ViewPictures(
        view=folder.name, frame=frame, sensor=sensor, cameras=cameras,
        by_images=bool(attrs.get("above_lasers_by_images", False)),
        recorded_range_m=recorded_range_m, rendered_range_m=ranges_m,
        recorded_points_m=recorded_points_m, rendered_points_m=points_m,
    )  # fmt: skip


def _recorded_scan(root: Path, frame: int) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Linear range image (H, W) and points (N, 3) of a recorded frame, metres; None where absent."""
    pano, returns = root / "pano" / "pano.zarr", root / "sweeps" / "returns.zarr"
    range_m = points_m = None
    if pano.is_dir():
        stored = read_arrays(pano, "frame", "linear_range_m")
        for row in np.flatnonzero(stored["frame"] == frame)[:1]:
            range_m = stored["linear_range_m"][row]
    if returns.is_dir():
        stored = read_arrays(returns, "frame", "offsets", "points_m")
        for row in np.flatnonzero(stored["frame"] == frame)[:1]:
            points_m = stored["points_m"][stored["offsets"][row] : stored["offsets"][row + 1]]
    return range_m, points_m


def _camera(known: Path, methods: dict[str, Path], camera: str) -> CameraPair | None:
    """The middle image of one camera, of those whose truth is stored in `known`; None if there is none."""
    name = f"{camera}_frame"
    frames = read_arrays(methods["model"], name)[name]
    if not frames.size:
        return None
    of_view, of_truth = _pairs(known, camera, frames)
    middle = len(of_view) // 2
    row = int(of_view[middle]) if of_view.size else len(frames) // 2
    rendered = {}
    for method, path in methods.items():
        if camera in read_attrs(path).get("cameras", []):  # of the same instants as the model's
            rendered[method] = read_arrays(path, f"{camera}_rgb")[f"{camera}_rgb"][row]
    frame, truth = int(frames[row]), None
    if of_view.size:
        stored = read_arrays(known, f"{camera}_rgb", name)
        truth, frame = (stored[key][of_truth[middle]] for key in (f"{camera}_rgb", name))
    return CameraPair(camera=camera, frame=int(frame), truth=truth, rendered=rendered)


def _pairs(known: Path, camera: str, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which images of a view, (k,) rows, have a true one, and its row (k,) in `known`.

    Truth of a view of the catalogue says whose it is. Its frames are those asked for by time; on a path of
    the view's own these are not the recorded ones nearest in place, by which the view's images are numbered.

    Args:
        known: Zarr group of true images; it may be absent, or without this camera.
        camera: Name of the camera.
        frames: (n,) frames of the view's images.
    """
    if not (known.is_dir() and holds_array(known, f"{camera}_frame")):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    if holds_array(known, f"{camera}_row"):
        of_view = read_arrays(known, f"{camera}_row")[f"{camera}_row"]
        of_truth = np.flatnonzero(of_view < len(frames))
        return of_view[of_truth], of_truth
    true = read_arrays(known, f"{camera}_frame")[f"{camera}_frame"]
    _, of_view, of_truth = np.intersect1d(frames, true, return_indices=True)
    return of_view, of_truth


def mean_of(
    rows: Sequence[dict[str, Any]], protocol: str, metric: str, split: str = HELD_OUT
) -> tuple[float, int, int]:
    """One metric of a split: its mean over sensors, frames where it is defined, frames."""
    mine = [
        row
        for row in rows
        if (row["protocol"], row["metric"]) == (protocol, metric)
        and (row["split"], row["region"]) == (split, "all")
    ]
    values = [row["value"] for row in mine if row["n_defined"]]
    value = sum(values) / len(values) if values else math.nan
    return value, sum(row["n_defined"] for row in mine), sum(row["n_frames"] for row in mine)
