"""Scenes that break things, through the real stages: a result that states its doubt, or a useful error."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from nvsf_core.demo.cameras import LIDAR_TO_POSE
from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.errors import DataError, DivergedError
from nvsf_core.models.residual import lidar as residual_lidar
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.residual import FieldSpec, TrainingSpec
from nvsf_core.sensors.tables import HDL_64E
from nvsf_core.stages import Outcome, plan_run, run_named_stage
from nvsf_core.stages.inputs import read_evidence
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows

pytestmark = pytest.mark.usefixtures("without_lpips_and_mesh")
UP_TO_EVIDENCE = ("frames", "sweeps", "pano", "undistorted", "evidence")
WHOLE = (*UP_TO_EVIDENCE, "mesh", "field", "novel_views", "scene_metrics")
_GRID = FieldSpec(levels=2, log2_table=8)
SMOKE = replace(
    preset("smoke"),
    lidar_field=_GRID,
    lidar_training=TrainingSpec(steps=20, rays=128),
    depth_training=TrainingSpec(steps=5, rays=512),
)
SIZE = replace(DemoSize.tiny(), lasers=tuple(range(0, 64, 2)), firings=256)
"""Dense enough that an unbroken drive passes the checks that broken ones are told by."""
FAR_M = (5e6, -5e6, 5e6)
SHAPES = ("neighbouring_scans_agree_with_their_poses", "lasers_are_known", "no_two_returns_share_a_firing")


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("hard") / "drive"
    write_demo(root, size=SIZE)
    return root


@pytest.fixture(scope="module")
def usual(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Checks that the unbroken drive fails already: it is far too small for them."""
    doubted = _doubts(_run(_copy(drive, tmp_path_factory.mktemp("usual"))))
    assert not doubted & set(SHAPES)
    return doubted


def _copy(drive: Path, folder: Path, *, cameras: bool = False) -> DriveLayout:
    shutil.copytree(drive, folder / "drive")
    if not cameras:
        shutil.rmtree(folder / "drive" / "data_2d_raw")
        (folder / "drive" / "calibration" / "perspective.txt").unlink()
    return DriveLayout(folder / "drive", DEMO_SEQUENCE)


def _run(layout: DriveLayout, stages: tuple[str, ...] = WHOLE, **changed: object) -> dict[str, Outcome]:
    scene = SceneEntry(
        name="tiny", root=layout.root, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=3,
        **{"test_frames": (2,)} | changed,
    )  # fmt: skip
    run = plan_run(scene, layout.root.parent / "home", recipe=SMOKE)
    return {name: run_named_stage(name, run, lambda _: None) for name in stages}


def _doubts(outcomes: dict[str, Outcome]) -> set[str]:
    return {check.name for one in outcomes.values() for check in one.checks if not check.passed}


def _scans(layout: DriveLayout, change: Callable[[int, np.ndarray], np.ndarray]) -> None:
    for path in sorted((layout.velodyne_dir / "data").glob("*.bin")):
        rows = np.fromfile(path, "<f4").reshape(-1, 4)
        change(int(path.stem), rows).astype("<f4").tofile(path)


def _noise(share: float) -> Callable[[int, np.ndarray], np.ndarray]:
    """A change for `_scans` that throws a share of the points anywhere within some 20 m."""
    rng = np.random.default_rng(0)

    def throw(_: int, rows: np.ndarray) -> np.ndarray:
        thrown = rng.random(len(rows)) < share
        rows[thrown, :3] = rng.normal(0.0, 20.0, (int(thrown.sum()), 3))
        return rows

    return throw


def _poses(layout: DriveLayout, change: Callable[[np.ndarray], None]) -> None:
    lines = [line.split() for line in layout.poses_path.read_text().splitlines()]
    for line in lines:
        pose = np.array(line[1:], np.float64).reshape(3, 4)
        change(pose)
        line[1:] = [repr(float(value)) for value in pose.ravel()]
    layout.poses_path.write_text("\n".join(" ".join(line) for line in lines) + "\n")
    layout.cam0_to_world_path.unlink(missing_ok=True)


def _stand(layout: DriveLayout) -> None:
    """All poses are the first one."""
    still: list[np.ndarray] = []

    def stand(pose: np.ndarray) -> None:
        still.append(pose.copy())
        pose[:] = still[0]

    _poses(layout, stand)


def _metrics(layout: DriveLayout) -> list[dict[str, object]]:
    store = layout.root.parent / "home" / "tiny"
    return read_rows(store / "scene_metrics/smoke/0/metrics.parquet")


def _never_silent(layout: DriveLayout) -> None:
    """Metrics were made; what is undefined rests on nothing and is NaN, never 0."""
    rows = _metrics(layout)
    assert any(np.isfinite(row["value"]) for row in rows)
    whole = [row for row in rows if row["region"] == "all" and row["n_valid"] == 0]
    assert [row for row in whole if np.isfinite(row["value"])] == []


def _drive_through(layout: DriveLayout, range_of: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
    """Write scans of a world that is alike all along x, and poses 1 m apart on it; nothing in it moves.

    Args:
        layout: Of the drive to write over.
        range_of: From rays' origins and directions (N, 3) to the range of what they meet, inf for nothing.
    """
    table, lasers = HDL_64E, np.array(SIZE.lasers)
    column = np.arange(0, table.lattice_steps, table.lattice_steps // 250)
    azimuth = np.mod((column + table.phase_steps[lasers][:, None]) * table.step_rad, 2.0 * np.pi)
    azimuth = np.sort(azimuth, axis=1).ravel()
    laser = np.repeat(np.arange(len(lasers)), len(column))
    elevation, beside = table.elevation_rad[lasers][laser], table.horizontal_offset_m[lasers][laser]
    above = table.vertical_offset_m[lasers][laser] / np.cos(elevation)
    origin = np.stack([-beside * np.sin(azimuth), beside * np.cos(azimuth), above], axis=-1)
    flat = np.cos(elevation)
    direction = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    range_m = range_of(origin, direction)
    met = range_m < 79.0
    for frame in range(SIZE.frames):
        noise_m = np.random.default_rng(frame).normal(0.0, 0.01, met.sum())
        points = origin[met] + direction[met] * (range_m[met] + noise_m)[:, None]
        turned = np.mod(np.arctan2(points[:, 1], points[:, 0]), 2.0 * np.pi)
        order = np.lexsort((turned, laser[met]))
        rows = np.column_stack([points, np.full(len(points), 0.3)])[order]
        rows.astype("<f4").tofile(layout.scan_path(frame))
    along_m = iter(range(SIZE.frames))

    def place(pose: np.ndarray) -> None:
        pose[:] = np.linalg.inv(LIDAR_TO_POSE)[:3]
        pose[0, 3] += next(along_m)

    _poses(layout, place)


def _plane(origin: np.ndarray, direction: np.ndarray, axis: int, at_m: float) -> np.ndarray:
    """Range to a plane across an axis, inf behind it."""
    with np.errstate(divide="ignore"):
        range_m = (at_m - origin[:, axis]) / direction[:, axis]
    return np.where(range_m > 0.0, range_m, np.inf)


def _plain(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    return _plane(origin, direction, 2, -1.7)


def _tunnel(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    walls = ((1, -3.0), (1, 3.0), (2, -1.7), (2, 3.3))
    return np.minimum.reduce([_plane(origin, direction, axis, at_m) for axis, at_m in walls])


@pytest.mark.parametrize("world", [_plain, _tunnel], ids=["empty plain", "tunnel"])
def test_where_nothing_moves_nothing_is_found_moving(
    drive: Path, tmp_path: Path, usual: set[str], world: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> None:
    layout = _copy(drive, tmp_path)
    _drive_through(layout, world)
    outcomes = _run(layout, compensate=False)
    _never_silent(layout)
    assert outcomes["evidence"].metadata["moving_objects"] == 0
    # A world alike all along itself does not tell where it was seen from: said, and no pose is blamed.
    laid = next(check for check in outcomes["sweeps"].checks if check.name == SHAPES[0])
    assert laid.passed and "nothing can be said along" in laid.detail


def test_everything_moving_is_doubted(drive: Path, tmp_path: Path, usual: set[str]) -> None:
    layout = _copy(drive, tmp_path)
    _stand(layout)
    outcomes = _run(layout)
    _never_silent(layout)
    assert "neighbouring_scans_agree_with_their_poses" in _doubts(outcomes) - usual


def test_one_percent_of_noise_is_counted(drive: Path, tmp_path: Path, usual: set[str]) -> None:
    layout = _copy(drive, tmp_path)
    _scans(layout, _noise(0.01))
    outcomes = _run(layout)
    _never_silent(layout)
    assert "lasers_are_known" in _doubts(outcomes) - usual
    # The few wrong returns do not take the other 99 % with them.
    assert outcomes["novel_views"].metadata["test_returns_per_sweep"] > 0.8 * SIZE.firings * 32 * 0.9


def test_a_scan_in_snow_drops_no_beam_of_the_others(drive: Path, tmp_path: Path) -> None:
    returns, throw = [], _noise(0.2)
    for name, spoil in (("snow", throw), ("absent", lambda _, rows: rows[:0])):
        layout = _copy(drive, tmp_path / name)
        _scans(layout, lambda frame, rows, spoil=spoil: spoil(frame, rows) if frame == 1 else rows)
        outcomes = _run(layout, WHOLE[:-1])
        assert ("lasers_are_known" in _doubts(outcomes)) == (name == "snow")
        returns.append(outcomes["novel_views"].metadata["test_returns_per_sweep"])
    assert returns[0] == pytest.approx(returns[1], rel=0.1)


def test_where_the_sensor_stands_a_scan_in_snow_answers_for_no_ray(drive: Path, tmp_path: Path) -> None:
    layout, throw = _copy(drive, tmp_path), _noise(0.2)
    _scans(layout, lambda frame, rows: throw(frame, rows) if frame == 1 else rows)
    _stand(layout)
    _run(layout, ("frames", "sweeps", "evidence"))
    evidence = read_evidence(SceneStore(tmp_path / "home", "tiny"))
    assert evidence is not None and evidence.stationary is not None
    assert evidence.prior.is_unidentified.tolist() == [False, True, False]
    assert evidence.stationary.scan.tolist() == [0, 2]


def test_a_scan_with_ten_times_the_points_is_doubted(drive: Path, tmp_path: Path, usual: set[str]) -> None:
    layout = _copy(drive, tmp_path)
    _scans(layout, lambda frame, rows: np.tile(rows, (10, 1)) if frame == 1 else rows)
    outcomes = _run(layout)
    _never_silent(layout)
    assert "no_two_returns_share_a_firing" in _doubts(outcomes) - usual
    # A firing returns once, however often it is written down.
    assert outcomes["novel_views"].metadata["test_returns_per_sweep"] <= SIZE.firings * len(SIZE.lasers)


def test_a_camera_that_sees_only_sky_is_doubted(drive: Path, tmp_path: Path, usual: set[str]) -> None:
    layout = _copy(drive, tmp_path, cameras=True)
    for path in layout.camera_dir("image_00").glob("*.png"):
        sky = np.full(cv2.imread(str(path)).shape, (235, 190, 140), np.uint8)
        cv2.imwrite(str(path), sky + np.linspace(0, 20, sky.shape[0], dtype=np.uint8)[:, None, None])
    outcomes = _run(layout)
    _never_silent(layout)
    assert {"image_00_sees_structure", "rendered_images_are_not_blank"} <= _doubts(outcomes) - usual
    shown = [row["value"] for row in _metrics(layout) if row["metric"] == "image_psnr_db"]
    assert shown and not any(value == 0.0 for value in shown)


def test_scans_of_other_frames_are_doubted(drive: Path, tmp_path: Path, usual: set[str]) -> None:
    layout = _copy(drive, tmp_path)
    first, last = layout.scan_path(0), layout.scan_path(3)
    early = first.read_bytes()
    first.write_bytes(last.read_bytes())
    last.write_bytes(early)
    doubted = _doubts(_run(layout, ("frames", "sweeps"))) - usual
    assert "neighbouring_scans_agree_with_their_poses" in doubted


def test_times_that_step_back_are_doubted(drive: Path, tmp_path: Path, usual: set[str]) -> None:
    layout = _copy(drive, tmp_path)
    path = layout.timestamps_path()
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[k] for k in (2, 1, 0, 3)) + "\n")
    outcomes = _run(layout, ("frames",))
    assert "timestamps_are_usable" in _doubts(outcomes) - usual
    assert "steps back" in str(outcomes["frames"].metadata["time_source"])


def test_the_order_of_the_poses_lines_changes_nothing(drive: Path, tmp_path: Path) -> None:
    tables = []
    for name, step in (("forward", 1), ("backward", -1)):
        layout = _copy(drive, tmp_path / name)
        lines = layout.poses_path.read_text().splitlines()[::step]
        layout.poses_path.write_text("\n".join(lines) + "\n")
        _run(layout, ("frames",))
        tables.append(read_rows(tmp_path / name / "home/tiny/frames/frames.parquet"))
    assert tables[0] == tables[1]


def test_poses_far_out_give_the_same_evidence(drive: Path, tmp_path: Path) -> None:
    found = []
    for name, shift in (("near", (0.0, 0.0, 0.0)), ("far", FAR_M)):
        layout = _copy(drive, tmp_path / name)
        _poses(layout, lambda pose, shift=shift: pose.__setitem__((slice(None), 3), pose[:, 3] + shift))
        _run(layout, UP_TO_EVIDENCE)
        evidence = read_evidence(SceneStore(tmp_path / name / "home", "tiny"))
        assert evidence is not None
        found.append(evidence.static)
    near, far = found
    assert len(near.hits) == len(far.hits) and np.array_equal(near.hits, far.hits)
    assert np.abs(near.mean_m - far.mean_m).max() <= 1e-3


def test_a_stationary_car_gives_a_result(drive: Path, tmp_path: Path) -> None:
    layout = _copy(drive, tmp_path)
    first: dict[str, np.ndarray] = {}
    _scans(layout, lambda frame, rows: first.setdefault("rows", rows))
    _stand(layout)
    _run(layout)
    _never_silent(layout)


def test_intensities_of_zero_give_a_result(drive: Path, tmp_path: Path) -> None:
    layout = _copy(drive, tmp_path)
    _scans(layout, lambda _, rows: rows * np.array([1, 1, 1, 0], np.float32))
    _run(layout)
    _never_silent(layout)


def test_one_training_frame_gives_a_result_that_is_doubted(
    drive: Path, tmp_path: Path, usual: set[str]
) -> None:
    layout = _copy(drive, tmp_path)
    outcomes = _run(layout, test_frames=(0, 1, 2))
    _never_silent(layout)
    assert outcomes["novel_views"].metadata["test_sweeps"] == 3
    # What a single scan did not see is copied from it, as if the sensor had not moved.
    assert "little_of_a_view_is_guessed" in _doubts(outcomes) - usual


def test_frames_fifty_metres_apart_are_doubted(drive: Path, tmp_path: Path, usual: set[str]) -> None:
    layout = _copy(drive, tmp_path)
    count = iter(range(100))
    _poses(layout, lambda pose: pose.__setitem__((0, 3), pose[0, 3] + 50.0 * next(count)))
    outcomes = _run(layout)
    _never_silent(layout)
    assert "car_moves_plausibly" in _doubts(outcomes) - usual


def test_noise_alone_is_doubted_and_nothing_to_train_on(drive: Path, tmp_path: Path, usual: set[str]) -> None:
    layout = _copy(drive, tmp_path)
    _scans(layout, _noise(1.0))
    outcomes = _run(layout, UP_TO_EVIDENCE)
    assert set(SHAPES[:2]) <= _doubts(outcomes) - usual
    with pytest.raises(DataError, match=r"scene tiny.*expected scans whose lasers are known"):
        _run(layout, ("field",))


def test_a_frame_without_returns_is_named(drive: Path, tmp_path: Path) -> None:
    layout = _copy(drive, tmp_path)
    _scans(layout, lambda frame, rows: rows[:0] if frame == 1 else rows)
    outcomes = _run(layout)
    _never_silent(layout)
    left_out = [check for check in outcomes["frames"].checks if check.name == "all_scans_are_usable"]
    assert not left_out[0].passed and "1 scans left out: 1:" in left_out[0].detail


def test_a_nan_in_a_batch_names_scene_step_and_term(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = _copy(drive, tmp_path)
    _run(layout, UP_TO_EVIDENCE)
    whole = residual_lidar.depth_loss
    monkeypatch.setattr(residual_lidar, "depth_loss", lambda w, r, t: whole(w, r, t * float("nan")))
    with pytest.raises(DivergedError, match=r"scene tiny.*lidar.*step 0.*'depth'.*batch"):
        _run(layout, ("field",))
