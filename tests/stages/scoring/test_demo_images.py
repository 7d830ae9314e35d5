"""True images of the demo's views: what its cameras recorded, or would have."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.demo.cameras import BASELINE_M, LIDAR_TO_POSE, demo_camera
from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry, ViewEntry
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.simulation.view_plan import ViewPlan, mount_pose
from nvsf_core.stages.runner.run import plan_run, run_named_stage
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.scoring.demo_images import demo_images
from nvsf_core.stages.scoring.demo_truth import DemoTruth, read_demo_truth
from nvsf_core.stages.scoring.rows import Ledger
from nvsf_core.stages.scoring.view_images import TrueImages, measure_view_images, write_truth
from nvsf_core.stages.views.view import plan_arrays, plan_attrs
from nvsf_core.stores.arrays import read_arrays, write_arrays
from nvsf_core.stores.schemas import CONTRACT, violations

SPECS = {spec.path: spec for spec in CONTRACT}

SIZE = replace(DemoSize.tiny(), frames=3, cameras=("image_00", "image_01"), fisheye_side=96)
CAMERAS = ("image_00", "image_01", "image_02")
COSTS = dict.fromkeys(("train_seconds", "parameters", "model_mb", "peak_memory_mb"), 0.0)


@dataclass(frozen=True)
class Street:
    task: Task
    truth: DemoTruth

    @property
    def recorded(self) -> dict[str, np.ndarray]:
        return read_arrays(self.task.store.path("undistorted") / "images.zarr")

    def true_images(self, view: ViewEntry, time_s: float, folder: Path) -> dict[str, TrueImages]:
        """Of a view of one instant; only instants and cameras of the model's view are read."""
        frame = np.array([round(time_s / 0.1)])
        plan = ViewPlan(view.name, frame, np.array([time_s]), mount_pose(view))
        arrays = plan_arrays(plan) | {f"{camera}_frame": frame for camera in CAMERAS}
        write_arrays(folder / "model.zarr", arrays, plan_attrs(plan) | {"cameras": list(CAMERAS)})
        return {one.camera: one for one in demo_images(self.task, folder / "model.zarr", view, self.truth)}


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Street:
    folder = tmp_path_factory.mktemp("street")
    write_demo(folder / "drive", size=SIZE)
    entry = SceneEntry(
        name="tiny", root=folder / "drive", sequence=DEMO_SEQUENCE, first_frame=0, last_frame=2,
        test_frames=(1,),
    )  # fmt: skip
    run = plan_run(entry, folder / "home", recipe="smoke")
    for stage in ("frames", "sweeps", "undistorted"):
        run_named_stage(stage, run, lambda line: None)
    task = Task(scene=entry, store=run.store, config=run.config, folder=folder, progress=lambda line: None)
    truth = read_demo_truth(task)
    assert truth is not None and truth.is_of_this_drive
    return Street(task, truth)


def test_the_truth_of_a_recorded_place_is_the_recorded_image(street: Street, tmp_path: Path) -> None:
    recorded = street.recorded
    found = street.true_images(ViewEntry(name="unshifted"), 0.2, tmp_path)
    assert tuple(found) == CAMERAS
    for camera, one in found.items():
        image = recorded[f"{camera}_rgb"][recorded[f"{camera}_frame"].tolist().index(2)]
        # The instant comes from the drive's clock, so an edge may fall into the next pixel.
        apart = np.abs(one.rgb[0].astype(int) - image)
        assert (apart > 1).mean() < 1e-3, camera
        assert (one.valid == recorded[f"{camera}_valid"]).all() and one.frame.tolist() == [2]


def test_a_camera_shifted_to_where_the_other_one_is_sees_what_that_one_recorded(
    street: Street, tmp_path: Path
) -> None:
    in_lidar = invert_pose(LIDAR_TO_POSE) @ demo_camera("image_00", SIZE.width, SIZE.height).image_to_pose
    forward, left, up = in_lidar[:3, :3] @ (BASELINE_M, 0.0, 0.0)
    view = ViewEntry(name="other_camera", shift_m=(float(forward), float(left), float(up)))
    shifted = street.true_images(view, 0.1, tmp_path)["image_00"].rgb[0].astype(int)
    other = street.recorded["image_01_rgb"][1]
    assert left < -0.59
    assert (np.abs(shifted - other) > 1).mean() < 1e-3
    assert np.abs(shifted - street.recorded["image_00_rgb"][1]).mean() > 5.0


def test_a_view_to_the_left_shows_what_lies_to_the_left(street: Street, tmp_path: Path) -> None:
    # Half the field of a pinhole with a focal length of 0.3925 widths, from its axis to its left border.
    border_deg = float(np.rad2deg(np.arctan(0.4841 / 0.3925)))
    view = ViewEntry(name="yaw", yaw_deg=border_deg)
    turned = street.true_images(view, 0.1, tmp_path)["image_00"].rgb[0].astype(int)
    straight = street.recorded["image_00_rgb"][1]
    # What was at the left border is now ahead: the turned image's axis shows its colours.
    column = turned[:, round(0.4841 * SIZE.width)]
    apart = [np.abs(column - straight[:, u]).mean() for u in (0, SIZE.width // 2, SIZE.width - 1)]
    assert apart[0] == min(apart) and apart[0] < 0.7 * apart[2]


def test_a_view_is_measured_by_its_own_rows_and_holes_are_counted(street: Street, tmp_path: Path) -> None:
    truth = street.true_images(ViewEntry(name="shift_1m", shift_m=(0.0, 1.0, 0.0)), 0.1, tmp_path)["image_00"]
    holed = truth.rgb.copy()
    holed[:, :12] = 0
    images = np.concatenate([np.zeros_like(holed), holed])
    write_arrays(
        tmp_path / "mesh.zarr", {"image_00_rgb": images, "image_00_render_seconds": np.array([0.1, 0.2])}
    )
    ledger = Ledger(facts={"scene": "tiny", "commit": "abc", "recipe": "mesh", "seed": 0, **COSTS})
    list(
        measure_view_images(
            tmp_path / "mesh.zarr", "shift_1m", replace(truth, row=np.array([1])), ledger, None
        )
    )
    rows = {row["metric"]: row for row in ledger.rows}
    assert {(row["split"], row["protocol"], row["sensor"]) for row in rows.values()} == {
        ("shift_1m", "image", "image_00")
    }
    assert rows["image_missing"]["value"] == pytest.approx(0.25, abs=1e-6)
    assert rows["image_psnr_db"]["render_seconds"] == 0.2
    assert 3.0 < rows["image_psnr_db"]["value"] < 20.0
    assert np.isnan(rows["image_lpips_squeeze"]["value"])


def test_the_truth_is_stored_as_the_contract_has_it(street: Street, tmp_path: Path) -> None:
    truths = street.true_images(ViewEntry(name="ahead", shift_m=(1.0, 0.0, 0.0)), 0.0, tmp_path)
    write_truth(tmp_path, list(truths.values()))
    arrays = read_arrays(tmp_path / "truth.zarr")
    assert violations(SPECS["scene_metrics/<recipe>/<seed>/<view>/truth.zarr"], arrays) == []
    assert (arrays["image_02_rgb"] == truths["image_02"].rgb).all()
