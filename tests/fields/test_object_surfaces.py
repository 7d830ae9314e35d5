"""Laws of the field on moving objects: a plate that slides past a wall."""

from typing import NamedTuple

import numpy as np
import pytest
import torch

from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.evidence.moving.object_evidence import (
    MovingObject,
    MovingObjects,
    ObjectEvidence,
    ObjectHitPriors,
)
from nvsf_core.evidence.moving.objects import ObjectSurfels, objects_at, prove_objects
from nvsf_core.evidence.surfels import Surfels, build_surfels
from nvsf_core.fields.lidar_field import (
    LidarField,
    ObjectSurfaces,
    SurfaceBatch,
    join_surfaces,
    object_places,
    object_surfaces,
    surface_batch,
)
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.recipe.residual import FieldSpec
from nvsf_core.rendering.lidar import render_rays
from nvsf_core.rendering.reproject import reproject_rays
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import HDL_64E

BOUNDS = Bounds(centre_m=(0.0, 0.0, 0.0), half_m=20.0)
SPEC = FieldSpec(levels=3, log2_table=10)
WALL_M, PLATE_M = 12.03, 8.02
SCANS, FRAME_S = 6, 0.1
LIMITS = {"near_m": 0.9, "far_m": 50.0}


def rays_towards(y_m: np.ndarray, z_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    target = np.column_stack([np.full(len(y_m), PLATE_M), y_m, z_m])
    direction = (target / np.linalg.norm(target, axis=1, keepdims=True)).astype(np.float32)
    return np.zeros_like(direction), direction


def plate_centre_m(time_s: np.ndarray) -> np.ndarray:
    return 10.0 * time_s - 2.5


class Scene(NamedTuple):
    """Surfels without the moving plate, and the plate."""

    static: Surfels
    objects: tuple[ObjectEvidence, ...]


@pytest.fixture(scope="module")
def dynamic() -> Scene:
    """Six scans; in the third the plate is brighter than in all others."""
    rng = np.random.default_rng(0)
    scan = np.repeat(np.arange(SCANS), 6000)
    time_s = scan * FRAME_S + rng.uniform(-0.04, 0.04, len(scan))
    y_m, z_m = rng.uniform(-5, 5, len(scan)), rng.uniform(-1, 1, len(scan))
    origin, direction = rays_towards(y_m, z_m)
    on_plate = (np.abs(y_m - plate_centre_m(time_s)) < 1.0) & (np.abs(z_m) < 0.5)
    range_m = (np.where(on_plate, PLATE_M, WALL_M) / direction[:, 0]).astype(np.float32)
    intensity = np.where(on_plate, np.where(scan == 2, 0.9, 0.5), 0.2)
    instants = np.arange(SCANS) * FRAME_S
    pose = np.column_stack([np.full(SCANS, PLATE_M), plate_centre_m(instants), 0 * instants, 0 * instants])
    path = MovingObject(
        np.arange(SCANS, dtype=np.int32), instants, pose, FRAME_S,
        np.array([-0.05, -1.0, -0.5]), np.array([0.05, 1.0, 0.5]),
    )  # fmt: skip
    moving = MovingObjects((path,), np.where(on_plate, 0, -1).astype(np.int32))
    rays = (origin, direction, range_m, intensity)
    objects = prove_objects(moving, *rays, time_s, np.arange(SCANS + 1) * 6000)
    return Scene(build_surfels(*rays, voxel_m=0.2, is_surface=~on_plate), objects)


def plate_at(dynamic: Scene, time_s: float, leave_out: int | None = None) -> tuple[ObjectSurfels]:
    """The plate about a time, half of whose surfels the scans never got back."""
    instants = np.arange(SCANS) * FRAME_S
    is_hit = np.ones((64, 400), bool)
    is_hit[(HDL_64E.elevation_rad + HDL_64E.vertical_offset_m / PLATE_M) < 0.0] = False
    fraction = np.tile((np.arange(400, dtype=np.float32) + 0.5) / 400 - 0.5, (SCANS, 1))
    prior = DropPrior(instants, fraction, np.tile(is_hit, (SCANS, 1, 1)))
    still = Trajectory(instants, np.tile(np.eye(4), (SCANS, 1, 1)), np.eye(4))
    hit_priors = ObjectHitPriors(prior, np.arange(64, dtype=np.int16), still, HDL_64E, 0.0)
    (plate,) = objects_at(dynamic.objects, time_s, hit_priors, leave_out=leave_out)
    return (plate,)


@pytest.fixture(scope="module")
def view(dynamic: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    origin, direction = rays_towards(rng.uniform(-4.5, 4.5, 800), rng.uniform(-0.4, 0.4, 800))
    return origin, direction, rng.uniform(0.22, 0.28, 800)


def batch_of(dynamic: Scene, view, field: LidarField, most: int = 24) -> SurfaceBatch:
    places = field.places(dynamic.objects)
    objects = object_surfaces(plate_at(dynamic, 0.25), places, *view, **LIMITS)
    return surface_batch(dynamic.static, *view[:2], most=most, objects=objects, **LIMITS)


def dense(surfaces: ObjectSurfaces) -> np.ndarray:
    """(m, c) index of each ray's surfaces, -1 behind its last."""
    count = np.diff(surfaces.first)
    step = np.arange(int(count.max(initial=0)))
    return np.where(step < count[:, None], surfaces.first[:-1, None] + step, -1)


def test_an_untrained_field_answers_on_objects_as_the_evidence_does(dynamic, view) -> None:
    field = LidarField(SPEC, BOUNDS, torch.Generator().manual_seed(0))
    hit_prior = np.random.default_rng(4).uniform(0.3, 0.9, len(view[0])).astype(np.float32)
    learned = render_rays(field, batch_of(dynamic, view, field), torch.from_numpy(hit_prior))
    proven = reproject_rays(
        dynamic.static, *view[:2], hit_prior, most=24, far_m=50.0, objects=plate_at(dynamic, 0.25),
        time_s=view[2],
    )  # fmt: skip
    assert np.mean(np.abs(proven.range_m * view[1][:, 0] - PLATE_M) < 0.1) > 0.15
    # The field's logits are limited, the evidence's opacities are not: a tie may fall to either side.
    assert np.mean(np.abs(learned.range_m - proven.range_m) < 1e-4) > 0.995
    assert np.abs(learned.intensity - proven.intensity).max() < 0.02
    # On objects the prior itself is shown, elsewhere the field's logit starts from a limited one.
    limited = np.where(learned.on_object, proven.hit, np.clip(proven.hit, 0.02, 0.98))
    assert np.mean(np.abs(learned.hit - limited) < 0.01) > 0.99


def test_surfaces_stay_in_order_and_the_nearest_are_kept(dynamic, view) -> None:
    field = LidarField(SPEC, BOUNDS, torch.Generator().manual_seed(0))
    full, short = batch_of(dynamic, view, field), batch_of(dynamic, view, field, most=3)
    ranges_m = [batch.spread(batch.range_m[:, None])[..., 0] for batch in (full, short)]
    for batch, range_m in zip((full, short), ranges_m, strict=True):
        ranges = torch.where(batch.is_there, range_m, torch.inf)
        assert (ranges[:, 1:] >= ranges[:, :-1]).all()
        moving = batch.hit_prior >= 0.0
        assert moving.sum() > 100
        ray = batch.is_there.nonzero()[:, 0]
        where_m = torch.from_numpy(view[0])[ray] + torch.from_numpy(view[1])[ray] * batch.range_m[:, None]
        apart = (batch.point_m - where_m).norm(dim=1)
        assert apart[~moving].max() < 1e-4 and apart[moving].min() > 1.0
    assert short.is_there.shape[1] == 3
    assert torch.equal(ranges_m[1], ranges_m[0][:, :3])


def test_an_objects_corrections_lie_where_they_lie_whenever_it_is_seen(dynamic) -> None:
    field = LidarField(SPEC, BOUNDS, torch.Generator().manual_seed(0))
    places = field.places(dynamic.objects)
    seen = []
    for time_s in (0.21, 0.29):
        ahead = np.linspace(-0.8, 0.8, 50)
        origin, direction = rays_towards(ahead + plate_centre_m(np.array(time_s)), np.full(50, 0.1))
        met = object_surfaces(
            plate_at(dynamic, 0.25), places, origin, direction, np.full(50, time_s), **LIMITS
        )
        seen.append(met.place_m[np.unique(dense(met)[:, 0])])
    assert np.abs(np.median(seen[0], axis=0) - np.median(seen[1], axis=0)).max() < 0.1


def test_a_training_ray_never_sees_its_own_scans_object(dynamic) -> None:
    origin, direction = rays_towards(np.linspace(-1.2, 0.2, 200), np.full(200, 0.1))
    time_s = np.full(200, 0.2)
    places = object_places((dynamic.objects[0].path,), BOUNDS, 4.0)
    rays = (origin, direction, time_s)
    held_out = object_surfaces(plate_at(dynamic, 0.2, leave_out=2), places, *rays, **LIMITS)
    told = object_surfaces(plate_at(dynamic, 0.2), places, *rays, **LIMITS)
    assert len(held_out.ray) > 100
    assert np.abs(held_out.intensity - 0.5).max() < 1e-5  # the bright scan is the third, and left out
    assert told.intensity.max() > 0.55


def test_drawn_rays_keep_their_surfaces(dynamic, view) -> None:
    places = object_places((dynamic.objects[0].path,), BOUNDS, 4.0)
    whole = object_surfaces(plate_at(dynamic, 0.25), places, *view, **LIMITS)
    halves = [
        object_surfaces(plate_at(dynamic, 0.25), places, *(column[half] for column in view), **LIMITS)
        for half in (slice(0, 300), slice(300, 800))
    ]
    joined = join_surfaces(halves, [300, 500])
    assert np.array_equal(joined.ray, whole.ray) and np.array_equal(joined.first, whole.first)
    drawn = np.array([799, 5, 5, *whole.ray[:40].tolist(), 0])
    part = joined.of(drawn)
    for row, ray in enumerate(drawn):
        own = whole.range_m[np.concatenate([dense(whole)[whole.ray == ray].ravel(), [-1]])[:-1]]
        own = own[dense(whole)[whole.ray == ray].ravel() >= 0]
        again = dense(part)[part.ray == row].ravel()
        assert np.array_equal(part.range_m[again[again >= 0]], own)
    nothing = whole.of(np.setdiff1d(np.arange(800), whole.ray))
    assert len(nothing.ray) == len(nothing.range_m) == 0


def test_objects_have_room_of_their_own_in_the_cube() -> None:
    low, high = np.array([-2.0, -1.0, 0.0]), np.array([2.0, 1.0, 1.5])
    paths = tuple(
        MovingObject(np.zeros(1, np.int32), np.zeros(1), np.zeros((1, 4)), FRAME_S, low, high + 0.1 * k)
        for k in range(30)
    )
    places = object_places(paths, BOUNDS, 2.0)
    centres = places + np.array([0.5 * (one.low_m + one.high_m) for one in paths])
    apart = np.abs(centres[:, None] - centres[None]).max(axis=2) + 1e9 * np.eye(30)
    assert apart.min() > max((one.high_m - one.low_m).max() for one in paths) + 1.9
    assert np.abs(centres).max() < BOUNDS.half_m
    assert centres[:, 2].min() > 5.0
