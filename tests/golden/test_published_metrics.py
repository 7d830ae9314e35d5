"""The published protocol against an independent implementation written from its description.

Tolerances are relative 1e-9 for sums in another order, and 1e-6 dB where NVSF's PSNR adds 1e-8.
"""

import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.kitti360.boxes import read_boxes
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.kitti360.scans import parse_scan, read_scan_bytes
from nvsf_core.geometry.boxes import box_rectangles
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import exp_so3, invert_pose
from nvsf_core.metrics.depth import published_depth_rmse
from nvsf_core.metrics.foreground import cut_pano, image_regions, lidar4d_regions
from nvsf_core.metrics.image import image_metrics
from nvsf_core.metrics.measure import Measure
from nvsf_core.metrics.protocols import PanoImage, lidar4d
from nvsf_core.sensors.linear_pano import LinearPano
from tests.conftest import SHARED

sys.path.insert(0, str(Path(__file__).parent))
import plain_metrics as plain  # tests are no package

PANO = LinearPano(height=24, width=80, reference_quirks=True)
VIEW = (PANO.fov_up_deg, PANO.fov_deg)
DRIVE = SHARED / "data" / "kitti0005_van_cyclist"
SEQUENCE = "2013_05_28_drive_9005_sync"


def _box(centre: tuple[float, float, float], size: tuple[float, float, float], yaw: float) -> np.ndarray:
    box = np.eye(4)
    box[:3, :3] = exp_so3(np.array([0.02, -0.03, yaw])) @ np.diag(size)
    box[:3, 3] = centre
    return box


BOXES = np.stack(
    [_box((9.0, 1.0, -1.0), (5.0, 3.0, 3.0), 0.4), _box((-6.0, -5.0, -0.8), (3.0, 2.0, 2.0), 1.2)]
)


def _panos(seed: int = 0) -> tuple[PanoImage, PanoImage]:
    """A street with two objects, and a prediction that is off, drops wrongly and doubts."""
    rng = np.random.default_rng(seed)
    shape = (PANO.height, PANO.width)
    direction = PANO.directions()
    ground = np.where(direction[..., 2] < -0.02, -1.7 / np.minimum(direction[..., 2], -1e-3), 90.0)
    wall = 14.0 / np.maximum(np.abs(direction[..., 1]), 0.05)
    range_m = np.minimum(np.minimum(ground, wall), 70.0)
    for box in BOXES:
        towards = direction @ box[:3, 3] / np.linalg.norm(box[:3, 3])
        range_m = np.where(towards > 0.985, np.minimum(range_m, np.linalg.norm(box[:3, 3])), range_m)
    dropped = rng.random(shape) < 0.15
    truth_m = np.where(dropped, 0.0, range_m).astype(np.float32)
    light = np.where(dropped, 0.0, rng.random(shape)).astype(np.float32)
    chance = np.clip(np.where(dropped, 0.3, 0.8) + rng.normal(0.0, 0.2, shape), 0.0, 1.0).astype(np.float32)
    guess_m = (range_m + rng.normal(0.0, 0.3, shape)).astype(np.float32)
    guess = PanoImage(range_m=guess_m, intensity=np.clip(light + 0.1, 0, 1).astype(np.float32), hit=chance)
    hit = (truth_m > 0.0).astype(np.float32)
    return guess, PanoImage(range_m=truth_m, intensity=light, hit=hit)


def _agree(found: Mapping[str, Measure], golden: dict[str, float]) -> None:
    for name, value in golden.items():
        assert found[name].value == pytest.approx(value, rel=1e-9, abs=1e-12), name


def _plain(predicted: PanoImage, truth: PanoImage) -> dict[str, float]:
    sides = (predicted.range_m, predicted.intensity, predicted.hit), (truth.range_m, truth.intensity)
    return plain.lidar_metrics(*sides, *VIEW)


def test_whole_panos() -> None:
    predicted, truth = _panos()
    _agree(lidar4d(predicted, truth, PANO, None), _plain(predicted, truth))


@pytest.mark.parametrize("region", ["foreground", "background"])
def test_regions_are_cut_by_each_sides_own_points_and_compared_over_the_full_image(region: str) -> None:
    predicted, truth = _panos(1)
    found = lidar4d_regions(predicted, truth, PANO, BOXES, None)[region]
    cut = []
    for side in (predicted, truth):
        mask = plain.object_mask(side.range_m * (side.hit > 0.5), list(BOXES), *VIEW)
        assert 5 < mask.sum() < 200
        keep = mask if region == "foreground" else ~mask
        cut.append(
            PanoImage(range_m=side.range_m * keep, intensity=side.intensity * keep, hit=side.hit * keep)
        )
    _agree(found, _plain(*cut))


def test_a_predicted_point_beside_the_box_vanishes_instead_of_counting_as_wrong() -> None:
    _, truth = _panos(2)
    far = PanoImage(
        range_m=truth.range_m + 3.0 * (truth.range_m > 0), intensity=truth.intensity, hit=truth.hit
    )
    cut = cut_pano(far, PANO, BOXES, "foreground")
    assert np.count_nonzero(cut.range_m) < 0.5 * np.count_nonzero(
        cut_pano(truth, PANO, BOXES, "foreground").hit
    )


def _images() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    truth = rng.integers(0, 256, (30, 44, 3)).astype(np.uint8)
    noisy = truth.astype(np.int64) + rng.integers(-30, 31, truth.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8), truth


def test_camera_images_whole_and_inside_the_rectangles() -> None:
    predicted, truth = _images()
    camera = Pinhole(fx=30.0, fy=30.0, cx=21.3, cy=14.8, width=44, height=30)
    boxes = np.stack(
        [
            _box((1.0, 0.5, 8.0), (2.0, 1.5, 4.0), 0.3),
            _box((-6.0, 0.0, 9.0), (2.0, 1.5, 3.0), 0.1),
            _box((0.0, 0.0, 0.5), (2.0, 2.0, 4.0), 0.0),
        ]
    )
    mask = box_rectangles(camera, boxes)
    assert (mask == plain.rectangle_mask(camera.matrix, (30, 44), list(boxes))).all()
    assert 20 < mask.sum() < 1000
    valid = np.ones((30, 44), dtype=bool)
    regions = image_regions(predicted, truth, valid, mask, None)
    kept = mask[..., None]
    for found, golden in (
        (image_metrics(predicted, truth, valid, None), plain.camera_metrics(predicted, truth)),
        (regions["foreground"], plain.camera_metrics(predicted * kept, truth * kept)),
        (regions["background"], plain.camera_metrics(predicted * ~kept, truth * ~kept)),
    ):
        assert found["image_psnr_db"].value == pytest.approx(golden["image_psnr_db"], abs=1e-3)
        assert found["image_ssim"].value == pytest.approx(golden["image_ssim"], abs=1e-9)


def test_published_camera_depth_counts_zeros_over_all_pixels() -> None:
    rng = np.random.default_rng(6)
    ray_m = rng.uniform(1.0, 120.0, (20, 30))
    z_m = np.where(rng.random((20, 30)) < 0.1, 0.97 * ray_m + rng.normal(0.0, 0.5, (20, 30)), 0.0)
    found = published_depth_rmse(ray_m, z_m).value
    assert found == pytest.approx(plain.published_depth_rmse(ray_m, z_m), rel=1e-9)


def test_ssim_of_the_plain_implementation_is_scikit_images() -> None:
    oracle = pytest.importorskip("skimage.metrics").structural_similarity
    predicted, truth = (side.range_m.astype(np.float64) for side in _panos(7))
    data_range = float(np.ptp(truth))
    expected = oracle(truth, predicted, data_range=data_range)
    assert plain.window_ssim(predicted, truth, data_range) == pytest.approx(expected, abs=1e-12)


@pytest.mark.skipif(not DRIVE.is_dir(), reason=f"no real drive at {DRIVE}")
def test_real_panos_of_a_van_and_a_cyclist() -> None:
    """Two neighbouring scans of a recorded drive on a coarser pano, whole and inside the annotated boxes."""
    pano = LinearPano(height=22, width=128, reference_quirks=True)
    layout = DriveLayout(DRIVE, SEQUENCE)
    poses = np.loadtxt(layout.cam0_to_world_path)
    panos = []
    for frame in (20, 21):
        path = layout.scan_path(frame)
        scan = parse_scan(path, read_scan_bytes(path)).points
        range_m, intensity = pano.project(scan[:, :3], scan[:, 3])
        panos.append(PanoImage(range_m=range_m, intensity=intensity, hit=(range_m > 0).astype(np.float32)))
    boxes = [box for box in read_boxes(layout.boxes_path("train"), 20, 20)[0] if box.dynamic]
    lidar_to_world = _lidar_to_world(layout, poses, 20)
    in_lidar = np.stack([invert_pose(lidar_to_world) @ box.box_to_world for box in boxes])
    view = (pano.fov_up_deg, pano.fov_deg)
    found = {"all": lidar4d(panos[1], panos[0], pano, None)}
    found |= lidar4d_regions(panos[1], panos[0], pano, in_lidar, None)
    masks = [plain.object_mask(side.range_m, list(in_lidar), *view) for side in panos]
    assert masks[0].sum() > 10
    for region, keeps in (("all", [np.ones_like(mask) for mask in masks]), ("foreground", masks)):
        truth, predicted = (
            (side.range_m * keep, side.intensity * keep, side.hit * keep)
            for side, keep in zip(panos, keeps, strict=True)
        )
        _agree(found[region], plain.lidar_metrics(predicted, truth[:2], *view))


def _lidar_to_world(layout: DriveLayout, poses: np.ndarray, frame: int) -> np.ndarray:
    """Pose of the LiDAR by the drive's own files: camera 0 to world, and camera 0 to LiDAR."""
    row = poses[poses[:, 0] == frame][0]
    camera_to_lidar = np.eye(4)
    camera_to_lidar[:3] = np.loadtxt(layout.cam_to_velo_path).reshape(3, 4)
    found: np.ndarray = row[1:].reshape(4, 4) @ np.linalg.inv(camera_to_lidar)
    return found
