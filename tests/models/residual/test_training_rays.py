"""Laws of the rays that a residual field is trained on: a plate that slides past a wall, six scans."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.evidence.moving.object_evidence import MovingObject, MovingObjects
from nvsf_core.evidence.moving.objects import prove_objects
from nvsf_core.evidence.scene_evidence import LeftOutEvidence, SceneEvidence
from nvsf_core.evidence.surfels import build_surfels
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.models.residual.lidar import LidarRays, learned_scans, training_rays
from nvsf_core.recipe.residual import FieldSpec, ResidualRecipe
from nvsf_core.recording.drive import LidarRecording, Sweeps
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import HDL_64E
from nvsf_core.simulation.ray_renderers import field_renderer

WALL_M, PLATE_M = 12.03, 8.02
SCANS, RETURNS, PERIOD_S = 6, 3000, 0.1
BRIGHT = 2
RECIPE = ResidualRecipe(name="test")


@pytest.fixture(scope="module")
def drive() -> LidarRecording:
    """The plate is brighter in one scan than in all others; the sensor stands."""
    rng = np.random.default_rng(0)
    scan = np.repeat(np.arange(SCANS), RETURNS)
    y_m, z_m = rng.uniform(-5, 5, len(scan)), rng.uniform(-1, 1, len(scan))
    target = np.column_stack([np.full(len(scan), PLATE_M), y_m, z_m])
    direction = (target / np.linalg.norm(target, axis=1, keepdims=True)).astype(np.float32)
    fraction = -np.arctan2(y_m, PLATE_M) / (2 * np.pi)
    time_s = (scan + fraction) * PERIOD_S
    on_plate = (np.abs(y_m - (10.0 * time_s - 2.5)) < 1.0) & (np.abs(z_m) < 0.5)
    range_m = (np.where(on_plate, PLATE_M, WALL_M) / direction[:, 0]).astype(np.float32)
    intensity = np.where(on_plate, np.where(scan == BRIGHT, 0.9, 0.5), 0.2).astype(np.float32)
    rays = (np.zeros_like(direction), direction, range_m, intensity)
    instants, offsets = np.arange(SCANS) * PERIOD_S, np.arange(SCANS + 1) * RETURNS
    still = Trajectory(instants, np.tile(np.eye(4), (SCANS, 1, 1)), np.eye(4))
    none = np.zeros(SCANS)
    path = MovingObject(
        np.arange(SCANS, dtype=np.int32), instants,
        np.column_stack([none + PLATE_M, 10.0 * instants - 2.5, none, none]), PERIOD_S,
        np.array([-0.05, -1.0, -0.5]), np.array([0.05, 1.0, 0.5]),
    )  # fmt: skip
    moving = MovingObjects((path,), np.where(on_plate, 0, -1).astype(np.int32))
    is_hit = np.ones((SCANS, 64, 400), bool)
    is_hit[:, 20] = False
    firing = np.tile((np.arange(400, dtype=np.float32) + 0.5) / 400 - 0.5, (SCANS, 1))
    own = np.zeros((64, 400), np.float32)
    evidence = SceneEvidence(
        build_surfels(*rays, voxel_m=0.2, is_surface=~on_plate), DropPrior(instants, firing, is_hit),
        np.arange(64, dtype=np.int16), np.full(SCANS, 400, np.int32), own, own,
        prove_objects(moving, *rays, time_s, offsets),
    )  # fmt: skip
    arrays = {
        "time_s": instants, "offsets": offsets, "is_own_vehicle": np.zeros(len(scan), bool),
        "is_mirrored": np.zeros(len(scan), bool),
        "laser": np.zeros(len(scan), np.int16), "range_m": range_m, "intensity": intensity,
        "sweep_fraction": fraction.astype(np.float32), "origin_m": rays[0], "direction": direction,
    }  # fmt: skip
    sweeps = Sweeps(arrays, np.ones(SCANS, bool), still, PERIOD_S, HDL_64E, 0.0)
    return LidarRecording(sweeps=sweeps, evidence=evidence)


def rays_of(drive: LidarRecording) -> LidarRays:
    bounds = Bounds(centre_m=(0.0, 0.0, 0.0), half_m=20.0)
    field = LidarField(FieldSpec(levels=2, log2_table=8), bounds, torch.Generator().manual_seed(0))
    return training_rays(drive, RECIPE, field)


def test_a_training_ray_never_sees_its_own_scans_object(drive: LidarRecording) -> None:
    rays = rays_of(drive)
    assert rays.objects is not None
    a_scan = len(rays) // SCANS  # returns, then the 400 firings of the laser that never returns
    assert a_scan == RETURNS + 400
    scan_of = np.repeat(rays.objects.ray, np.diff(rays.objects.first)) // a_scan
    brightest = np.array([rays.objects.intensity[scan_of == scan].max() for scan in range(SCANS)])
    assert abs(brightest[BRIGHT] - 0.5) < 1e-5
    assert brightest[[1, 3]].min() > 0.55


def test_an_object_is_met_where_its_ray_ends(drive: LidarRecording) -> None:
    rays = rays_of(drive)
    assert rays.objects is not None
    nearest_m = np.full(len(rays), np.inf, np.float32)
    nearest_m[rays.objects.ray] = rays.objects.range_m[rays.objects.first[:-1]]
    on_plate = (rays.intensity > 0.4) & (rays.range_m > 0)
    assert np.mean(np.abs(nearest_m - rays.range_m)[on_plate] < 0.1) > 0.9


def test_on_an_object_no_learned_hit_is_shown(drive: LidarRecording) -> None:
    bounds = Bounds(centre_m=(0.0, 0.0, 0.0), half_m=20.0)
    field = LidarField(FieldSpec(levels=2, log2_table=8), bounds, torch.Generator().manual_seed(0))
    with torch.no_grad():
        list(field.hit_head.parameters())[-1].fill_(9.0)  # its bias: each ray returns
    towards = np.array([[PLATE_M, 0.0, 0.0], [PLATE_M, 3.5, 0.0]])
    direction = (towards / np.linalg.norm(towards, axis=1, keepdims=True)).astype(np.float32)
    render = field_renderer(field, drive.evidence.static, drive.moving(), most=8, far_m=drive.far_m)
    shown = render(np.zeros((2, 3), np.float32), direction, np.full(2, 0.3, np.float32), np.full(2, 0.25))
    assert shown.on_object is not None and shown.on_object.tolist() == [True, False]
    assert abs(shown.range_m[0] - PLATE_M) < 0.2 < shown.range_m[1] - PLATE_M
    assert shown.hit_prior is not None and shown.hit[0] == shown.hit_prior[0]
    assert shown.hit[1] > 0.99, "beside it the field decides"


def test_rays_of_a_static_scene_carry_nothing_dynamic(drive: LidarRecording) -> None:
    static = replace(drive, evidence=replace(drive.evidence, objects=()))
    rays = rays_of(static)
    assert rays.objects is None
    assert len(rays) == SCANS * (RETURNS + 400)


def unknown_lasers(drive: LidarRecording, *scans: int) -> LidarRecording:
    """The drive without motion, of some of whose scans no laser is known."""
    evidence, laser = drive.evidence, drive.sweeps.arrays["laser"].copy()
    is_hit = evidence.prior.is_hit.copy()
    for scan in scans:
        laser[drive.sweeps.returns_of(scan)], is_hit[scan] = -1, False
    prior = replace(evidence.prior, is_hit=is_hit)
    return LidarRecording(
        sweeps=replace(drive.sweeps, arrays=drive.sweeps.arrays | {"laser": laser}),
        evidence=replace(evidence, prior=prior, objects=()),
    )


def test_no_beam_is_dropped_by_a_scan_of_which_no_laser_is_known(drive: LidarRecording) -> None:
    rays = rays_of(unknown_lasers(drive, 1, 3))
    assert len(rays) == (SCANS - 2) * (RETURNS + 400)
    returned = rays.range_m > 0.0
    assert (rays.hit_prior[returned] == 1.0).all() and not rays.hit_prior[~returned].any()


def test_one_scan_of_known_lasers_trains_as_one_scan_alone(drive: LidarRecording) -> None:
    rays = rays_of(unknown_lasers(drive, 0, 1, 3, 4, 5))
    assert len(rays) == RETURNS + 400
    assert (rays.hit_prior == (rays.range_m > 0.0)).all()


def test_neither_judges_nor_silent_scans_are_learned_from(drive: LidarRecording) -> None:
    judged = unknown_lasers(drive, 1)
    left_out = LeftOutEvidence(np.array([2, 4]), drive.evidence.static)
    judged = replace(judged, evidence=replace(judged.evidence, left_out=left_out))
    assert learned_scans(judged) == [(0, 0), (3, 3), (5, 5)]
