"""How rigid a thing moved is read off its surface."""

from dataclasses import replace

import numpy as np
import pytest

from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.evidence.dynamic import DynamicEvidence
from nvsf_core.evidence.moving import MovingObject
from nvsf_core.evidence.objects import ObjectEvidence, ObjectRays
from nvsf_core.evidence.rigidity import not_rigid_share, surface_distance_m
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.evidence.surfels import build_surfels
from nvsf_core.stages.profile import scene_profile

SCANS, RETURNS, SPEED_M = 6, 800, 0.3
"""Scans that see a thing, its returns in each, and how far it comes from scan to scan."""


def passing(bend_m: np.ndarray) -> ObjectEvidence:
    """A plate of 2 x 1 m, seen from 8 m; scan k sees its upper half `bend_m[k]` nearer than the lower."""
    random = np.random.default_rng(0)
    scan = np.repeat(np.arange(SCANS, dtype=np.int32), RETURNS)
    y, z = random.uniform(-1.0, 1.0, len(scan)), random.uniform(-0.5, 0.5, len(scan))
    point_o = np.column_stack([np.where(z > 0.0, -bend_m[scan], 0.0), y, z])
    origin_o = np.column_stack([np.full(len(scan), -8.0), -SPEED_M * scan, np.zeros(len(scan))])
    ray = point_o - origin_o
    range_m = np.linalg.norm(ray, axis=1)
    instants = 0.1 * np.arange(SCANS)
    pose = np.column_stack([np.full(SCANS, 8.0), SPEED_M * np.arange(SCANS), 0 * instants, 0 * instants])
    path = MovingObject(
        np.arange(SCANS, dtype=np.int32), instants, pose, 0.1, point_o.min(axis=0), point_o.max(axis=0)
    )
    rays = ObjectRays(
        origin_o.astype(np.float32), (ray / range_m[:, None]).astype(np.float32), range_m.astype(np.float32),
        np.ones(len(scan), np.float32), np.ones(len(scan), bool), scan,
    )  # fmt: skip
    return ObjectEvidence(path, rays)


def test_a_rigid_thing_lies_on_its_own_surface() -> None:
    assert not_rigid_share((passing(np.zeros(SCANS)),)) == 0.0


@pytest.mark.parametrize(
    "bend_m", [0.3 * np.arange(SCANS), np.array([0.0, 0.4, 0.0, 0.4, 0.0, 0.4])], ids=["bends", "swings"]
)
def test_what_bends_between_scans_fits_no_rigid_motion(bend_m: np.ndarray) -> None:
    bent = passing(bend_m)
    assert 0.3 < not_rigid_share((bent,)) < 0.6, "the upper half"
    both = not_rigid_share((bent, passing(np.zeros(SCANS))))
    assert np.isclose(both, 0.5 * not_rigid_share((bent,)), atol=0.01)


def test_a_wrong_path_fits_as_little_as_no_rigidity() -> None:
    plate = passing(np.zeros(SCANS))
    nearer = plate.rays.origin_m + 0.3 * plate.rays.scan[:, None] * np.array([1.0, 0.0, 0.0], np.float32)
    assert not_rigid_share((replace(plate, rays=replace(plate.rays, origin_m=nearer)),)) > 0.95


def test_the_profile_says_it_of_what_moves_and_nothing_of_what_was_not_seen_enough() -> None:
    plate, place = passing(np.zeros(SCANS)), np.array([[1.0, 0.0, 0.0]], np.float32)
    surfels = build_surfels(0 * place, place, np.full(1, 9.0), np.ones(1), voxel_m=0.2, threads=1)
    nobody = np.zeros((0, 0), np.float32)
    prior = DropPrior(plate.path.time_s, nobody, nobody.astype(bool))
    scene = SceneEvidence(
        surfels, prior, np.zeros(0, np.int16), np.zeros(0, np.int32), nobody, nobody,
        DynamicEvidence(surfels, (plate,)),
    )  # fmt: skip
    said = scene_profile(scene, [], 0.5)
    assert said["moving_not_rigid_share"] == 0.0
    assert "1 moving object, each in its own frame, 100% of whose returns fit a rigid motion; LiDAR" in str(
        said["profile"]
    )
    once = replace(plate, path=plate.path.without(0).without(1).without(2).without(3).without(4))
    said = scene_profile(replace(scene, dynamic=DynamicEvidence(surfels, (once,))), [], 0.5)
    assert "moving_not_rigid_share" not in said
    assert "each in its own frame; LiDAR" in str(said["profile"])


def test_nothing_is_told_of_what_one_scan_saw() -> None:
    plate = passing(np.zeros(SCANS))
    once = replace(plate, path=plate.path.without(0).without(1).without(2).without(3).without(4))
    assert not_rigid_share((once,)) is None
    assert not_rigid_share(()) is None


def test_nothing_is_told_of_what_is_too_far_to_be_resolved() -> None:
    bent = passing(0.3 * np.arange(SCANS))
    far = replace(
        bent.rays, range_m=bent.rays.range_m + 40.0, origin_m=bent.rays.origin_m - 40.0 * bent.rays.direction
    )
    assert not_rigid_share((replace(bent, rays=far),)) is None


def test_distance_to_a_surface_is_that_to_its_plane_and_unknown_where_nothing_was_seen():
    random = np.random.default_rng(0)
    seen = np.concatenate([random.uniform(-1, 1, (4000, 2)), random.normal(0, 1e-4, (4000, 1))], axis=1)
    asked = np.array([[0.0, 0.0, 0.03], [0.2, -0.3, 0.0], [0.0, 0.0, 2.0]])
    found = surface_distance_m(asked, seen)
    np.testing.assert_allclose(found[:2], [0.03, 0.0], atol=2e-3)
    assert np.isnan(found[2])
