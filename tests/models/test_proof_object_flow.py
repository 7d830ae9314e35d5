"""Flow for what bends, and none for what is rigid: a person whose limbs swing, and one whose are stiff."""

from dataclasses import replace

import numpy as np
import pytest

from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.evidence.moving.object_evidence import ObjectEvidence, ObjectHitPriors
from nvsf_core.evidence.moving.objects import objects_at
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.evidence.surfels import build_surfels
from nvsf_core.models.proof import choose_flow
from nvsf_core.rendering.reproject import reproject_rays
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import HDL_64E
from tests.evidence.moving.walkers import FRAME_S, Walk, rays_towards, walk_past

SCANS = 14
AHEAD = np.array([[1.0, 0.0, 0.0]], np.float32)
ANYTHING = build_surfels(0 * AHEAD, AHEAD, np.full(1, 9.0), np.ones(1), voxel_m=0.2)


@pytest.fixture(scope="module")
def walking() -> Walk:
    return walk_past(0.55, SCANS)


def error_m(walk: Walk, one: ObjectEvidence) -> float:
    """Mean range error, at most 0.5 m a ray, along rays at instants that no scan was taken at."""
    off_m = []
    for scan in range(3, SCANS - 3):
        time_s = FRAME_S * (scan + 0.5)
        origin, direction, range_m, is_hit = rays_towards(walk, time_s)
        surfels = one.surfels_from(one.scans_near(time_s), time_s)
        rendered = reproject_rays(
            surfels, origin[is_hit], direction[is_hit], np.ones(is_hit.sum(), np.float32), most=24, far_m=60.0
        )
        off_m.append(np.abs(rendered.range_m - range_m[is_hit]))
    off = np.concatenate(off_m)
    return float(np.minimum(np.where(np.isfinite(off), off, 0.5), 0.5).mean())


def test_limbs_that_swing_get_a_flow_that_shows_them_between_scans(walking: Walk) -> None:
    (shown,) = choose_flow((walking.evidence,))
    assert shown.flow_m is not None
    rigid_m, flowing_m = error_m(walking, walking.evidence), error_m(walking, shown)
    assert flowing_m < 0.85 * rigid_m, (rigid_m, flowing_m)


def test_a_scan_left_out_of_it_tells_the_flow_nothing(walking: Walk) -> None:
    """As if held out: its own returns lie elsewhere in vain."""
    (shown,) = choose_flow((walking.evidence,))
    scan = SCANS // 2
    time_s = FRAME_S * scan
    others = shown.scans_near(time_s, leave_out=scan)
    own = np.flatnonzero(shown.rays.scan == scan)
    elsewhere = shown.rays.origin_m.copy()
    elsewhere[own] += 3.0
    moved = replace(shown, rays=replace(shown.rays, origin_m=elsewhere)).with_flow()
    asked = [one.rays_at(others, time_s).origin_m for one in (shown, moved)]
    np.testing.assert_array_equal(*asked)
    assert not np.array_equal(asked[0], walking.evidence.rays_at(others, time_s).origin_m)


@pytest.mark.parametrize("lag_s", [0.0, 0.03, -0.04])
def test_an_object_is_shown_as_it_is_when_the_sweep_meets_it(walking: Walk, lag_s: float) -> None:
    """Its scans met it so long after their instants: asked for is a sweep's instant."""
    shown = walking.evidence.with_flow()
    met_s = shown.path.time_s
    instants = met_s - lag_s
    prior = DropPrior(instants, np.zeros((SCANS, 1), np.float32), np.ones((SCANS, 64, 1), bool))
    still = Trajectory(instants, np.tile(np.eye(4), (SCANS, 1, 1)), np.eye(4))
    hit_priors = ObjectHitPriors(prior, np.arange(64, dtype=np.int16), still, HDL_64E, 0.0)
    between_s = float(0.5 * (met_s[6] + met_s[7]))
    (one,) = objects_at((shown,), between_s - lag_s, hit_priors)
    expected = shown.surfels_from(np.arange(5, 9), between_s)
    assert expected is not None
    np.testing.assert_allclose(one.surfels.mean_m, expected.mean_m, atol=1e-5)


def test_what_few_scans_saw_stays_rigid(walking: Walk) -> None:
    few = walking.evidence.of_scans(np.arange(7))
    assert choose_flow((few,))[0].flow_m is None
    assert choose_flow((few.of_scans(np.zeros(0)),))[0].flow_m is None


def test_what_is_too_far_to_be_resolved_stays_rigid(walking: Walk) -> None:
    rays = walking.evidence.rays
    far = replace(rays, range_m=rays.range_m + 40.0, origin_m=rays.origin_m - 40.0 * rays.direction)
    assert choose_flow((replace(walking.evidence, rays=far),))[0].flow_m is None


def test_only_the_flow_of_what_bends_is_stored(walking: Walk) -> None:
    shown = walking.evidence.with_flow()
    prior = DropPrior(np.zeros(1), np.zeros((1, 4), np.float32), np.ones((1, 1, 4), bool))
    own = np.zeros((1, 4), np.float32)
    scene = SceneEvidence(
        ANYTHING, prior, np.zeros(1, np.int16), np.array([4]), own, own, (walking.evidence, shown)
    )
    arrays = scene.to_arrays()
    assert [name for name in arrays if "flow" in name] == ["object_flow_m_1"]
    rigid, bent = SceneEvidence.from_arrays(arrays).objects
    assert rigid.flow_m is None
    np.testing.assert_array_equal(bent.flow_m, shown.flow_m)


def test_somebody_stiff_allocates_no_flow() -> None:
    walk = walk_past(0.0, SCANS)
    (shown,) = choose_flow((walk.evidence,))
    assert shown is walk.evidence and shown.flow_m is None
