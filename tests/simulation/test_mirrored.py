"""Returns that the bonnet mirrors, in a simulated scan of a car that stands before a wall."""

import numpy as np
import pytest

from nvsf_core.evidence.drop_prior import build_drop_prior
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.evidence.surfels import build_surfels
from nvsf_core.recording.drive import LidarRecording, Sweeps
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.bonnet import Bonnet
from nvsf_core.sensors.sweep import SweepRays, Trajectory, sweep_rays
from nvsf_core.sensors.tables import HDL_64E
from nvsf_core.simulation.mirrored import add_mirrored
from nvsf_core.simulation.scan import RenderedSweep
from tests.sensors.bonnet_street import FIRINGS, SHAPE, ranges_of_street, scan_of_street

PERIOD_S = 0.1
NEARER_WALL_M = 16.5
"""Where the wall stands when the sweep is simulated: nearer than in the recorded scans."""


@pytest.fixture(scope="module")
def drive() -> LidarRecording:
    """Two scans of the street; the bonnet mirrors a hundredth of all rays."""
    scan, mirrored = scan_of_street(Bonnet(SHAPE))
    count = len(scan.laser)
    azimuth = np.arctan2(scan.points_m[:, 1], scan.points_m[:, 0])
    fraction = (-azimuth / (2 * np.pi)).astype(np.float32)
    firing = np.clip(((fraction + 0.5) * FIRINGS).astype(np.int16), 0, FIRINGS - 1)
    offsets, instants = np.arange(3) * count, np.arange(2) * PERIOD_S
    arrays = {
        "laser": scan.laser.astype(np.int16),
        "firing": firing,
        "sweep_fraction": fraction,
        "range_m": np.linalg.norm(scan.points_m, axis=1),
        "is_mirrored": mirrored,
        "intensity": np.where(mirrored, 0.4, 0.1).astype(np.float32),
    }
    arrays = {name: np.tile(column, 2) for name, column in arrays.items()}
    prior = build_drop_prior(
        arrays["laser"], arrays["firing"], arrays["sweep_fraction"], offsets, np.full(2, FIRINGS), instants,
        lasers=64, nominal_firings=FIRINGS,
    )  # fmt: skip
    ray = np.array([[1.0, 0.0, 0.0]], np.float32)
    surfels = build_surfels(0 * ray, ray, np.ones(1, np.float32), np.ones(1, np.float32), voxel_m=0.2)
    own = np.zeros((64, 4), np.float32)
    evidence = SceneEvidence(surfels, prior, np.arange(64, dtype=np.int16), np.full(2, FIRINGS), own, own)
    still = Trajectory(instants, np.tile(np.eye(4), (2, 1, 1)), np.eye(4))
    arrays |= {"offsets": offsets, "time_s": instants, "frame": np.arange(2), "bonnet_shape": SHAPE}
    sweeps = Sweeps(arrays, np.ones(2, bool), still, PERIOD_S, HDL_64E, 0.0)
    return LidarRecording(sweeps=sweeps, evidence=evidence)


def nearer_street(
    origin_m: np.ndarray, direction: np.ndarray, hit_prior: np.ndarray, time_s: np.ndarray
) -> RenderedRays:
    """The street with its wall moved nearer, as a renderer of rays."""
    range_m = ranges_of_street(origin_m.astype(np.float64), direction.astype(np.float64), NEARER_WALL_M)
    return RenderedRays(range_m.astype(np.float32), hit_prior, np.full(len(range_m), 0.1, np.float32))


def swept(drive: LidarRecording) -> SweepRays:
    return sweep_rays(HDL_64E, np.arange(64), FIRINGS, drive.sweeps.trajectory, 0.0, PERIOD_S)


def without_mirrored(rays: SweepRays) -> RenderedRays:
    hit = np.ones(len(rays.laser), np.float32)
    return nearer_street(rays.recorded_origin_m, rays.recorded_direction, hit, hit)


def test_mirrored_returns_are_as_many_as_recorded_and_show_what_stands_ahead_now(
    drive: LidarRecording,
) -> None:
    rays = swept(drive)
    rendered = add_mirrored(without_mirrored(rays), rays, drive, nearer_street, 0.0)
    points_m, intensity, _ = RenderedSweep.of(rays, rendered).scan()
    below = np.flatnonzero(points_m[:, 2] < -2.7)
    recorded = drive.sweeps.arrays["is_mirrored"].sum() / 2
    assert 0.8 * recorded < len(below) < 1.2 * recorded
    assert np.allclose(intensity[below], 0.4, atol=1e-3)
    # By way of the bonnet it is a little farther than straight on.
    range_m = np.linalg.norm(points_m[below], axis=1)
    assert (np.abs(range_m - NEARER_WALL_M) < 1.5).mean() > 0.5


def test_where_the_bonnet_mirrors_past_what_was_recorded_the_recorded_range_stays(
    drive: LidarRecording,
) -> None:
    def sky(
        origin_m: np.ndarray, direction: np.ndarray, hit_prior: np.ndarray, time_s: np.ndarray
    ) -> RenderedRays:
        return RenderedRays(np.full(len(origin_m), np.inf, np.float32), hit_prior, hit_prior)

    rays = swept(drive)
    after = add_mirrored(without_mirrored(rays), rays, drive, sky, 0.0)
    changed = np.flatnonzero(after.intensity > 0.3)
    arrays = drive.sweeps.arrays
    assert np.isin(after.range_m[changed], arrays["range_m"][arrays["is_mirrored"]].astype(np.float32)).all()
    assert len(changed) > 0


def test_a_drive_without_a_bonnet_is_rendered_as_before(drive: LidarRecording) -> None:
    arrays = {name: column for name, column in drive.sweeps.arrays.items() if name != "bonnet_shape"}
    plain = Sweeps(arrays, drive.sweeps.is_training, drive.sweeps.trajectory, PERIOD_S, HDL_64E, 0.0)
    rays = swept(drive)
    before = without_mirrored(rays)
    after = add_mirrored(
        before, rays, LidarRecording(sweeps=plain, evidence=drive.evidence), nearer_street, 0.0
    )
    assert after is before
