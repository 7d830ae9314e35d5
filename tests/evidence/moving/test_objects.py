"""Laws of moving objects' own evidence, on a plate that slides past a wall."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from nvsf_core.errors import ShapeError
from nvsf_core.evidence.drop_prior import DropPrior, build_drop_prior
from nvsf_core.evidence.moving.object_evidence import (
    MovingObject,
    MovingObjects,
    ObjectEvidence,
    ObjectHitPriors,
)
from nvsf_core.evidence.moving.objects import NearObjects, candidates_on, objects_at, prove_objects
from nvsf_core.evidence.scene_evidence import MOST, SceneEvidence
from nvsf_core.evidence.surfels import Surfels, build_surfels
from nvsf_core.rendering.reproject import reproject_rays
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import HDL_64E

WALL_M, PLATE_M = 12.03, 8.02
SCANS, FRAME_S = 6, 0.1
SPEED_M_S = 10.0
HERE = np.zeros((3, 3), np.float32)


def ray_towards(y_m: np.ndarray, z_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays from the origin to places of the plate's plane."""
    target = np.column_stack([np.full(len(y_m), PLATE_M), y_m, z_m])
    direction = target / np.linalg.norm(target, axis=1, keepdims=True)
    return np.zeros_like(direction, np.float32), direction.astype(np.float32)


def plate_centre_m(time_s: np.ndarray | float) -> np.ndarray | float:
    return SPEED_M_S * np.asarray(time_s) - 2.5


class Scene(NamedTuple):
    """Surfels without the moving plate, and the plate."""

    static: Surfels
    objects: tuple[ObjectEvidence, ...]


@pytest.fixture(scope="module")
def passing() -> tuple[Scene, Surfels]:
    """What six scans prove, and the surfels of everything as if nothing moved."""
    rng = np.random.default_rng(0)
    count = 6000
    scan = np.repeat(np.arange(SCANS), count)
    time_s = scan * FRAME_S + rng.uniform(-0.04, 0.04, len(scan))
    y_m, z_m = rng.uniform(-5, 5, len(scan)), rng.uniform(-1, 1, len(scan))
    origin, direction = ray_towards(y_m, z_m)
    on_plate = (np.abs(y_m - plate_centre_m(time_s)) < 1.0) & (np.abs(z_m) < 0.5)
    range_m = np.where(on_plate, PLATE_M, WALL_M) / direction[:, 0]
    intensity = np.where(on_plate, 0.9, 0.2)
    instants = np.arange(SCANS) * FRAME_S
    pose = np.column_stack([np.full(SCANS, PLATE_M), plate_centre_m(instants), 0 * instants, 0 * instants])
    path = MovingObject(
        np.arange(SCANS, dtype=np.int32), instants, pose, FRAME_S,
        np.array([-0.05, -1.0, -0.5]), np.array([0.05, 1.0, 0.5]),
    )  # fmt: skip
    moving = MovingObjects((path,), np.where(on_plate, 0, -1).astype(np.int32))
    rays = (origin, direction, range_m.astype(np.float32), intensity)
    objects = prove_objects(moving, *rays, time_s, np.arange(SCANS + 1) * count)
    static = build_surfels(*rays, voxel_m=0.2, is_surface=~on_plate)
    return Scene(static, objects), build_surfels(*rays, voxel_m=0.2)


def votes_of(is_hit: np.ndarray) -> ObjectHitPriors:
    """A sensor at rest whose lasers and firings (64, 400) returned alike in all scans."""
    instants = np.arange(SCANS) * FRAME_S
    fraction = np.tile((np.arange(400, dtype=np.float32) + 0.5) / 400 - 0.5, (SCANS, 1))
    prior = DropPrior(instants, fraction, np.tile(is_hit, (SCANS, 1, 1)))
    still = Trajectory(instants, np.tile(np.eye(4), (SCANS, 1, 1)), np.eye(4))
    return ObjectHitPriors(prior, np.arange(64, dtype=np.int16), still, HDL_64E, 0.0)


ALWAYS = votes_of(np.ones((64, 400), bool))


def test_a_place_votes_as_the_near_scans_returned_there(passing) -> None:
    dynamic, _ = passing
    is_hit = np.ones((64, 400), bool)
    is_hit[(HDL_64E.elevation_rad + HDL_64E.vertical_offset_m / PLATE_M) < 0.0] = False
    (plate,) = objects_at(dynamic.objects, 0.25, votes_of(is_hit))
    ahead, height = np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.4, 0.4, 33))
    place = np.column_stack([0.0 * ahead.ravel(), ahead.ravel(), height.ravel()])
    share = plate.hit_priors.share(place)
    assert share[place[:, 2] < -0.06].max() == 0.0
    assert share[place[:, 2] > 0.06].min() == 1.0
    # Between the last laser that returns and the first that does not it falls evenly.
    between = share.reshape(height.shape)[(height[:, 0] > -0.02) & (height[:, 0] < 0.02)]
    assert np.all(np.diff(share.reshape(height.shape), axis=0) >= -1e-6)
    assert between.min() > 0.0 and between.max() < 1.0


def test_the_nearest_scan_in_time_counts_most(passing) -> None:
    dynamic, _ = passing
    hit_priors, place = votes_of(np.ones((64, 400), bool)), np.zeros((1, 3))
    for dropped, low, high in ((2, 0.5, 0.6), (0, 0.85, 0.95)):
        hit_priors.prior.is_hit[...] = True
        hit_priors.prior.is_hit[dropped, 1:] = False
        (plate,) = objects_at(dynamic.objects, 0.2, hit_priors)
        assert low < plate.hit_priors.share(place)[0] < high


def test_a_scan_of_which_no_laser_is_known_has_no_vote_on_an_object(passing) -> None:
    dynamic, _ = passing
    hit_priors, place = votes_of(np.ones((64, 400), bool)), np.zeros((1, 3))
    hit_priors.prior.is_hit[2] = False
    (plate,) = objects_at(dynamic.objects, 0.2, hit_priors)
    assert plate.hit_priors.share(place)[0] == 1.0
    # Where no scan that saw it has a vote it is known by its returns alone.
    (nobody,) = hit_priors.near([(plate.path, np.array([2]))], 0.2)
    assert nobody.share(place).tolist() == [1.0]


def test_a_fast_plate_is_met_at_both_ends_of_a_long_sweep(passing) -> None:
    dynamic, _ = passing
    (plate,) = objects_at(dynamic.objects, 0.25, ALWAYS)
    instants = np.arange(SCANS) * 0.5
    y_m = 40.0 * (instants - instants.mean())
    pose = np.column_stack([np.full(SCANS, PLATE_M), y_m, 0 * y_m, 0 * y_m])
    fast = replace(plate, path=replace(plate.path, time_s=instants, pose=pose, frame_s=0.5))
    time_s = instants.mean() + np.linspace(-0.25, 0.25, 101)
    origin, direction = ray_towards(40.0 * (time_s - instants.mean()), 0 * time_s)
    met, _ = candidates_on(fast, origin, direction, time_s, near_m=0.5, far_m=50.0)
    assert met.tolist() == list(range(101))


def test_the_plate_is_where_it_is_at_each_rays_own_time(passing) -> None:
    dynamic, _ = passing
    time_s = np.random.default_rng(1).uniform(0.22, 0.28, 2000)
    y_m = np.random.default_rng(2).uniform(-4.5, 4.5, 2000)
    away = np.abs(y_m - plate_centre_m(time_s))
    origin, direction = ray_towards(y_m, np.full(2000, 0.1))
    rendered = reproject_rays(
        dynamic.static, origin, direction, np.ones(2000, np.float32), most=24, far_m=50.0,
        objects=objects_at(dynamic.objects, 0.25, ALWAYS), time_s=time_s,
    )  # fmt: skip
    depth = rendered.range_m * direction[:, 0]
    on, off = away < 0.9, away > 1.1
    # A voxel at the edge with too few returns for a plane is known to its own size only.
    assert np.abs(depth[on] - PLATE_M).max() < 0.1
    assert np.mean(np.abs(depth[on] - PLATE_M) < 0.02) > 0.97
    assert np.mean(np.abs(rendered.intensity[on] - 0.9) < 0.05) > 0.95
    assert np.abs(depth[off] - WALL_M).max() < 0.05


def test_what_moves_leaves_no_smear_in_the_background(passing) -> None:
    dynamic, everything = passing
    assert np.abs(everything.mean_m[:, 0] - PLATE_M).min() < 0.2
    assert np.abs(dynamic.static.mean_m[:, 0] - PLATE_M).min() > 3.0


def test_an_object_is_gone_long_after_its_last_scan(passing) -> None:
    dynamic, _ = passing
    assert len(objects_at(dynamic.objects, 0.62, ALWAYS)) == 1
    assert objects_at(dynamic.objects, 1.0, ALWAYS) == ()


def test_a_left_out_scan_is_not_asked(passing) -> None:
    dynamic, _ = passing
    plate = dynamic.objects[0]
    assert set(plate.scans_near(0.2)) == {0, 1, 2, 3}
    others = plate.scans_near(0.2, leave_out=2)
    assert set(others) == {0, 1, 3, 4}
    hits = plate.rays.is_hit & np.isin(plate.rays.scan, others)
    assert plate.surfels_from(others, 0.2).hits.sum() == hits.sum()


def test_where_an_object_was_is_not_told_by_a_left_out_scan(passing) -> None:
    """As in a held-out frame: its neighbours say where it was, and not its own, bent place."""
    dynamic, _ = passing
    straight = dynamic.objects[0]
    pose = straight.path.pose.copy()
    pose[2, 1] += 0.5
    bent = replace(straight, path=replace(straight.path, pose=pose))
    (told,) = objects_at((bent,), 0.2, ALWAYS)
    (untold,) = objects_at((bent,), 0.2, ALWAYS, leave_out=2)
    at = np.array([0.2])
    assert told.path.pose_at(at)[0, 1] == pytest.approx(pose[2, 1])
    assert np.allclose(untold.path.pose_at(at), straight.path.pose_at(at))
    (elsewhere,) = objects_at((bent,), 0.2, ALWAYS, leave_out=17)
    assert elsewhere.path is bent.path


def test_an_object_that_only_the_left_out_scan_saw_is_not_there(passing) -> None:
    plate = passing[0].objects[0]
    path, third = plate.path, slice(2, 3)
    once = replace(path, scan=path.scan[third], time_s=path.time_s[third], pose=path.pose[third])
    assert len(objects_at((replace(plate, path=once),), 0.2, ALWAYS)) == 1
    assert objects_at((replace(plate, path=once),), 0.2, ALWAYS, leave_out=2) == ()


def test_scans_that_did_not_see_an_object_prove_nothing_of_it(passing) -> None:
    assert passing[0].objects[0].surfels_from(np.array([99]), 0.2) is None


def test_parts_of_a_sweep_share_what_was_built(passing) -> None:
    near = NearObjects(passing[0].objects, ALWAYS)
    first = near.at(np.array([0.19, 0.21]), HERE)
    assert near.at(np.array([0.18, 0.21]), HERE) is first
    assert near.at(np.array([0.31]), HERE) is not first
    half_way = near.at(np.array([0.21, 0.248, 0.28]), HERE)
    assert near.at(np.array([0.22, 0.252, 0.28]), HERE) is half_way and half_way is not first
    assert near.at(np.zeros(0), HERE) == ()
    elsewhere = near.at(np.array([0.22, 0.252, 0.28]), HERE + 9.0)
    assert elsewhere is not half_way
    # Sweeps that are rendered at once ask in turn.
    assert near.at(np.array([0.2]), HERE) is first


def test_places_that_ask_the_same_scans_share_an_objects_surfels(passing) -> None:
    near = NearObjects(passing[0].objects, ALWAYS)
    (here,), (beside,) = (near.at(np.array([0.2]), HERE + np.array([x_m, 0.0, 0.0])) for x_m in (0.0, 1.0))
    (later,) = near.at(np.array([0.35]), HERE)
    assert here is not beside and here.surfels is beside.surfels
    assert later.surfels is not here.surfels
    alone = passing[0].objects[0].surfels_from(passing[0].objects[0].scans_near(0.2), 0.2)
    assert np.array_equal(here.surfels.mean_m, alone.mean_m)


def test_what_was_built_is_forgotten_after_some_instants(passing) -> None:
    near = NearObjects(passing[0].objects, ALWAYS)
    first = near.at(np.array([0.2]), HERE)
    for step in range(20):
        near.at(np.array([0.2]), HERE + 3.0 * (step + 1))
    assert near.at(np.array([0.2]), HERE) is not first


def test_an_object_seen_from_elsewhere_is_built_from_scans_that_saw_it_from_there(passing) -> None:
    one = passing[0].objects[0]
    near = one.scans_near(0.0)
    assert sorted(near) == [0, 1, 2, 3]
    # The sensor rests, the plate slides to its left: later scans see it from farther to its right.
    assert np.array_equal(one.scans_towards(0.0, np.zeros(3), near), near)
    assert one.scans_towards(0.0, np.array([0.0, -9.0, 0.0]), near).tolist() == [0, 1, 2, 3, 4, 5]
    # From beyond the first scan's place no other scan is nearer than the first.
    assert np.array_equal(one.scans_towards(0.0, np.array([0.0, 9.0, 0.0]), near), near)
    assert one.scans_towards(0.0, np.zeros(3), near[:0]).size == 0


def test_objects_without_times_are_refused(passing) -> None:
    dynamic, _ = passing
    origin, direction = ray_towards(np.zeros(3), np.zeros(3))
    with pytest.raises(ShapeError, match="times"):
        reproject_rays(
            dynamic.static, origin, direction, np.ones(3, np.float32), most=8, far_m=50.0,
            objects=objects_at(dynamic.objects, 0.2, ALWAYS),
        )  # fmt: skip


def test_evidence_comes_back_from_its_arrays(passing) -> None:
    dynamic, everything = passing
    prior = build_drop_prior(
        np.zeros(2, int), np.array([0, 1]), np.zeros(2), np.array([0, 2]), np.array([4]), np.zeros(1),
        lasers=1, nominal_firings=4,
    )  # fmt: skip
    own = np.zeros((1, 4), np.float32)
    scene = SceneEvidence(
        everything,
        prior,
        np.zeros(1, np.int16),
        np.array([4]),
        own,
        own,
        dynamic.objects,
        copied_share=MOST,
    )
    arrays = scene.to_arrays()
    again = SceneEvidence.from_arrays(arrays).to_arrays()
    assert arrays.keys() == again.keys()
    assert all(np.array_equal(arrays[name], again[name]) for name in arrays)


def test_a_static_scene_stores_nothing_dynamic(passing) -> None:
    _, everything = passing
    prior = build_drop_prior(
        np.zeros(2, int), np.array([0, 1]), np.zeros(2), np.array([0, 2]), np.array([4]), np.zeros(1),
        lasers=1, nominal_firings=4,
    )  # fmt: skip
    own = np.zeros((1, 4), np.float32)
    scene = SceneEvidence(everything, prior, np.zeros(1, np.int16), np.array([4]), own, own)
    arrays = scene.to_arrays()
    assert not any(name.startswith("object") for name in arrays)
    assert SceneEvidence.from_arrays(arrays).objects == ()
