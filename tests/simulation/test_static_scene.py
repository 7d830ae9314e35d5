"""A static scene asks nobody about motion."""

import numpy as np
import torch

from nvsf_core.evidence.drop_prior import build_drop_prior
from nvsf_core.evidence.moving.objects import NearObjects
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.evidence.surfels import build_surfels
from nvsf_core.fields.lidar_field import LidarField, surface_batch
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.recipe.residual import FieldSpec
from nvsf_core.recording.drive import LidarRecording, Sweeps
from nvsf_core.rendering.lidar import render_rays
from nvsf_core.rendering.reproject import NEAR_M
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import HDL_64E
from nvsf_core.simulation.ray_renderers import evidence_renderer, field_renderer


def _wall() -> tuple[SceneEvidence, np.ndarray, np.ndarray]:
    """Evidence of a wall 9 m ahead, where nothing moves, and rays at it."""
    direction = np.tile(np.array([[1.0, 0.0, 0.0]], np.float32), (8, 1))
    origin = np.zeros((8, 3), np.float32)
    surfels = build_surfels(origin, direction, np.full(8, 9.0, np.float32), np.ones(8), voxel_m=0.2)
    prior = build_drop_prior(
        np.zeros(2, int), np.array([0, 1]), np.zeros(2), np.array([0, 2]), np.array([4]), np.zeros(1),
        lasers=1, nominal_firings=4,
    )  # fmt: skip
    own = np.zeros((1, 4), np.float32)
    scene = SceneEvidence(surfels, prior, np.zeros(1, np.int16), np.array([4]), own, own)
    return scene, origin, direction


def _moving(scene: SceneEvidence) -> NearObjects | None:
    """Of a recording whose trajectory ends at 0.1 s: whoever asks it for the pose at 99 s gets an error."""
    short = Trajectory(np.array([0.0, 0.1]), np.tile(np.eye(4), (2, 1, 1)), np.eye(4))
    sweeps = Sweeps(
        arrays={}, is_training=np.ones(1, bool), trajectory=short, period_s=0.1, table=HDL_64E,
        elevation_correction_rad=0.0,
    )  # fmt: skip
    return LidarRecording(sweeps=sweeps, evidence=scene).moving()


def test_a_static_scene_queries_nothing_dynamic() -> None:
    scene, origin, direction = _wall()
    render = evidence_renderer(scene.static, _moving(scene), most=8, far_m=50.0)
    hit_prior = np.ones(8, np.float32)
    early = render(origin, direction, hit_prior, np.zeros(8))
    late = render(origin, direction, hit_prior, np.full(8, 99.0))
    assert np.array_equal(early.range_m, late.range_m)
    assert np.abs(early.range_m - 9.0).max() < 0.11


def test_a_field_of_a_static_scene_asks_nobody_about_motion_and_answers_from_its_surfaces() -> None:
    scene, origin, direction = _wall()
    bounds = Bounds(centre_m=(0.0, 0.0, 0.0), half_m=20.0)
    field = LidarField(FieldSpec(levels=2, log2_table=8), bounds, torch.Generator().manual_seed(0))
    hit_prior = np.full(8, 0.7, np.float32)
    render = field_renderer(field, scene.static, _moving(scene), most=8, far_m=50.0)
    rendered = render(origin, direction, hit_prior, np.full(8, 99.0))
    batch = surface_batch(scene.static, origin, direction, most=8, near_m=NEAR_M, far_m=50.0)
    assert (batch.hit_prior < 0.0).all()
    expected = render_rays(field, batch, torch.from_numpy(hit_prior))
    for name in ("range_m", "hit", "intensity"):
        assert np.array_equal(getattr(rendered, name), getattr(expected, name)), name
