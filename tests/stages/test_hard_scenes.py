"""Scenes that break things, through the real stages: a result that states its doubt, or a useful error."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.errors import DivergedError, NvsfError
from nvsf_core.kitti360.catalogue import SceneEntry
from nvsf_core.kitti360.demo import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.kitti360.layout import DriveLayout
from nvsf_core.recipe import FieldSpec, TrainingSpec, preset
from nvsf_core.stages import Outcome, plan_run, run_named_stage
from nvsf_core.stages.evidence import read_evidence
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows
from nvsf_core.training import lidar_step as steps

UP_TO_EVIDENCE = ("frames", "sweeps", "pano", "undistorted", "evidence")
WHOLE = (*UP_TO_EVIDENCE, "mesh", "field", "novel_views", "scene_metrics")
_GRID = FieldSpec(levels=2, log2_table=8)
SMOKE = replace(
    preset("smoke"),
    lidar_field=_GRID,
    lidar_training=TrainingSpec(steps=10, rays=128, threads=1),
    depth_training=TrainingSpec(steps=5, rays=512, threads=1),
    camera_training=TrainingSpec(steps=5, rays=512, threads=1),
)
FAR_M = (5e6, -5e6, 5e6)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("hard") / "drive"
    write_demo(root, size=DemoSize.tiny())
    shutil.rmtree(root / "data_2d_raw")
    (root / "calibration" / "perspective.txt").unlink()
    return root


def _copy(drive: Path, folder: Path) -> DriveLayout:
    shutil.copytree(drive, folder / "drive")
    return DriveLayout(folder / "drive", DEMO_SEQUENCE)


def _run(layout: DriveLayout, stages: tuple[str, ...] = WHOLE, **changed: object) -> dict[str, Outcome]:
    scene = SceneEntry(
        name="tiny", root=layout.root, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=3,
        **{"test_frames": (2,)} | changed,
    )  # fmt: skip
    run = plan_run(scene, layout.root.parent / "home", recipe=SMOKE)
    return {name: run_named_stage(name, run, lambda _: None) for name in stages}


def _scans(layout: DriveLayout, change: Callable[[int, np.ndarray], np.ndarray]) -> None:
    for path in sorted((layout.velodyne_dir / "data").glob("*.bin")):
        rows = np.fromfile(path, "<f4").reshape(-1, 4)
        change(int(path.stem), rows).astype("<f4").tofile(path)


def _poses(layout: DriveLayout, change: Callable[[np.ndarray], None]) -> None:
    lines = [line.split() for line in layout.poses_path.read_text().splitlines()]
    for line in lines:
        pose = np.array(line[1:], np.float64).reshape(3, 4)
        change(pose)
        line[1:] = [repr(float(value)) for value in pose.ravel()]
    layout.poses_path.write_text("\n".join(" ".join(line) for line in lines) + "\n")
    layout.cam0_to_world_path.unlink(missing_ok=True)


def _metrics(layout: DriveLayout) -> list[dict[str, object]]:
    store = layout.root.parent / "home" / "tiny"
    return read_rows(store / "scene_metrics/smoke/0/metrics.parquet")


def _never_silent(layout: DriveLayout) -> None:
    """Metrics were made; what is undefined rests on nothing and is NaN, never 0."""
    rows = _metrics(layout)
    assert any(np.isfinite(row["value"]) for row in rows)
    whole = [row for row in rows if row["region"] == "all" and row["n_valid"] == 0]
    assert [row for row in whole if np.isfinite(row["value"])] == []


def test_poses_far_out_give_the_same_evidence(drive: Path, tmp_path: Path) -> None:
    found = []
    for name, shift in (("near", (0.0, 0.0, 0.0)), ("far", FAR_M)):
        layout = _copy(drive, tmp_path / name)
        _poses(layout, lambda pose, shift=shift: pose.__setitem__((slice(None), 3), pose[:, 3] + shift))
        _run(layout, UP_TO_EVIDENCE)
        evidence = read_evidence(SceneStore(tmp_path / name / "home", "tiny"))
        assert evidence is not None
        found.append(evidence.surfels)
    near, far = found
    assert len(near.hits) == len(far.hits) and np.array_equal(near.hits, far.hits)
    assert np.abs(near.mean_m - far.mean_m).max() <= 1e-3


def test_a_stationary_car_gives_a_result(drive: Path, tmp_path: Path) -> None:
    layout = _copy(drive, tmp_path)
    first: dict[str, np.ndarray] = {}
    _scans(layout, lambda frame, rows: first.setdefault("rows", rows))
    still: list[np.ndarray] = []

    def stand(pose: np.ndarray) -> None:
        still.append(pose.copy())
        pose[:] = still[0]

    _poses(layout, stand)
    _run(layout)
    _never_silent(layout)


def test_intensities_of_zero_give_a_result(drive: Path, tmp_path: Path) -> None:
    layout = _copy(drive, tmp_path)
    _scans(layout, lambda _, rows: rows * np.array([1, 1, 1, 0], np.float32))
    _run(layout)
    _never_silent(layout)


def test_one_training_frame_is_a_result_or_an_error_that_names_the_scene(drive: Path, tmp_path: Path) -> None:
    layout = _copy(drive, tmp_path)
    try:
        _run(layout, test_frames=(0, 1, 2))
    except NvsfError as error:
        assert "tiny" in str(error) or "training scan" in str(error)
    else:
        _never_silent(layout)


def test_frames_fifty_metres_apart_are_doubted(drive: Path, tmp_path: Path) -> None:
    layout = _copy(drive, tmp_path)
    count = iter(range(100))
    _poses(layout, lambda pose: pose.__setitem__((0, 3), pose[0, 3] + 50.0 * next(count)))
    outcomes = _run(layout)
    _never_silent(layout)
    checks = [check for outcome in outcomes.values() for check in outcome.checks]
    assert any(not check.passed for check in checks)


def test_noise_alone_is_doubted(drive: Path, tmp_path: Path) -> None:
    layout = _copy(drive, tmp_path)
    rng = np.random.default_rng(0)

    def noise(_: int, rows: np.ndarray) -> np.ndarray:
        rows[:, :3] = rng.normal(0.0, 20.0, (len(rows), 3))
        return rows

    _scans(layout, noise)
    try:
        outcomes = _run(layout)
    except NvsfError as error:
        assert str(error)
    else:
        _never_silent(layout)
        checks = [check for outcome in outcomes.values() for check in outcome.checks]
        assert any(not check.passed for check in checks)


def test_a_frame_without_returns_is_named(drive: Path, tmp_path: Path) -> None:
    layout = _copy(drive, tmp_path)
    _scans(layout, lambda frame, rows: rows[:0] if frame == 1 else rows)
    outcomes = _run(layout)
    _never_silent(layout)
    checks = [check for outcome in outcomes.values() for check in outcome.checks]
    assert any("1" in check.detail and not check.passed for check in checks)


def test_a_nan_in_a_batch_names_scene_step_and_term(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = _copy(drive, tmp_path)
    _run(layout, UP_TO_EVIDENCE)
    whole = steps.depth_loss
    monkeypatch.setattr(steps, "depth_loss", lambda w, r, t: whole(w, r, t * float("nan")))
    with pytest.raises(DivergedError, match=r"scene tiny.*lidar.*step 0.*'depth'.*batch"):
        _run(layout, ("field",))
