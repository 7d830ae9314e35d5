"""Builds the evidence of a drive from its training scans: static surfaces, moving objects, hit priors."""

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.evidence.moving.detection import find_moving_objects
from nvsf_core.evidence.moving.objects import prove_objects
from nvsf_core.evidence.moving.rigid_path import MovingObjects
from nvsf_core.evidence.moving.timed_returns import TimedReturns
from nvsf_core.evidence.raydrop.prior import DropPrior, build_drop_prior, find_cells
from nvsf_core.evidence.raydrop.stationary_scans import StationaryScans, find_stationary_scans, keep_scans
from nvsf_core.evidence.raydrop.unit_gaps import GAP_CELLS, find_unit_gaps, places_apart
from nvsf_core.evidence.scene_evidence import DynamicEvidence, LeftOutEvidence, SceneEvidence
from nvsf_core.evidence.static.surfels import Surfels, build_surfels
from nvsf_core.evidence.static.unobserved import unobserved_beside
from nvsf_core.models.selection.object_flow import choose_flow
from nvsf_core.models.selection.voxel_size import FIELD_VOXEL_M, ScanRays, VoxelChoice, choose_voxel_m
from nvsf_core.recipe import EvidenceSpec
from nvsf_core.recording.sweeps import Sweeps, training_returns
from nvsf_core.rendering.reproject import reproject_rays
from nvsf_core.simulation.scan import sweep_rays

_GAP_SCANS = 12
"""Most scans in which gaps of the recorded unit are sought."""


def prove_scene(sweeps: Sweeps) -> tuple[SceneEvidence, dict[str, Scalar]]:
    """The evidence, and as metadata the validation scans' range error with each voxel size that was tried."""
    a = sweeps.arrays
    lengths = np.diff(a["offsets"])
    of_training = np.repeat(sweeps.is_training, lengths)
    used = of_training & sweeps.is_of_world()
    training = np.flatnonzero(sweeps.is_training)
    prior = build_drop_prior(
        a["laser"][of_training], a["firing"][of_training], a["sweep_fraction"][of_training],
        np.concatenate([[0], np.cumsum(lengths[training])]), a["firings"][training], a["time_s"][training],
        lasers=sweeps.table.laser_count, nominal_firings=sweeps.table.firings_per_turn,
    )  # fmt: skip
    firings = np.where(a["firings"][training] > 0, a["firings"][training], sweeps.table.firings_per_turn)
    lasers = np.unique(a["laser"][of_training])
    returns = training_returns(sweeps)
    moving = find_moving_objects(returns)
    is_static = np.ones(len(used), bool)
    is_static[np.flatnonzero(of_training)[moving.object_id >= 0]] = False
    rays = ScanRays(
        origin_m=a["origin_m"][used], direction=a["direction"][used], range_m=a["range_m"][used],
        intensity=sweeps.even_intensity(used), scan=np.repeat(np.arange(sweeps.count), lengths)[used],
        is_static=is_static[used],
    )  # fmt: skip
    choice = choose_voxel_m(
        rays,
        unidentified=training[prior.is_unidentified],
        far_m=float(sweeps.table.max_range_m),
    )
    best_m = FIELD_VOXEL_M if choice is None else choice.best_m
    surfels = build_surfels(
        rays.origin_m, rays.direction, rays.range_m, rays.intensity, voxel_m=FIELD_VOXEL_M
    )
    dynamic = None if moving.is_static else _prove_motion(sweeps, returns, moving, of_training, rays)
    static = surfels if dynamic is None else dynamic.static
    rendered = rays.surfels(best_m, shaped=True)
    evidence = SceneEvidence(
        surfels=surfels,
        prior=prior,
        lasers=lasers[lasers >= 0].astype(np.int16),
        firings=firings.astype(np.int32),
        own_range_m=a["own_vehicle_range_m"],
        own_intensity=a["own_vehicle_intensity"],
        dynamic=dynamic,
        stationary=_stationary_scans(sweeps, of_training, prior),
        rendered=rendered,
        left_out=None if choice is None else _left_out(choice, training),
        unobserved=unobserved_beside(static, rays.origin_m, rays.direction, rays.range_m),
        unit_gaps=_unit_gaps(sweeps, prior, rendered),
    )  # fmt: skip
    tried: dict[str, Scalar] = {"rendered_voxel_m": best_m}
    for voxel_m, error_m in ({} if choice is None else choice.errors_m).items():
        tried[f"left_out_error_m_at_{1000 * voxel_m:.0f}_mm"] = error_m
    return evidence, tried


def _unit_gaps(sweeps: Sweeps, prior: DropPrior, surfels: Surfels) -> np.ndarray | None:
    """Gaps of the recorded unit, see `find_unit_gaps`, by rays of some scans through static surfels."""
    _, position_m = sweeps.trajectory.at(prior.time_s)
    scans = places_apart(position_m, _GAP_SCANS)
    scans = scans[~prior.is_unidentified[scans]]
    lasers = np.arange(sweeps.table.laser_count)
    is_met = np.zeros((len(scans), len(lasers), GAP_CELLS), bool)
    for number, scan in enumerate(scans):
        rays = sweep_rays(
            sweeps.table, lasers, GAP_CELLS, sweeps.trajectory, float(prior.time_s[scan]), sweeps.period_s
        )
        rendered = reproject_rays(
            surfels, rays.origin_m, rays.direction, np.ones(len(rays.laser), np.float32),
            most=EvidenceSpec().lidar_candidates, far_m=float(sweeps.table.max_range_m),
        )  # fmt: skip
        is_met[number] = np.isfinite(rendered.range_m).reshape(rays.shape)
    return find_unit_gaps(prior, scans, is_met)


def _left_out(choice: VoxelChoice, training: np.ndarray) -> LeftOutEvidence:
    """Static surfaces without the validation scans, for the field and `reproject`; `training` (n,) scans."""
    return LeftOutEvidence(
        validation=np.searchsorted(training, choice.validation),
        static=choice.static,
        rendered=choice.rendered[choice.best_m],
    )


def _stationary_scans(sweeps: Sweeps, of_training: np.ndarray, prior: DropPrior) -> StationaryScans | None:
    """The training scans recorded while the sensor stood or crawled, with known lasers; None if none."""
    scans = find_stationary_scans(prior.time_s, sweeps.trajectory)
    scans = scans[~prior.is_unidentified[scans]]
    if len(scans) == 0:
        return None
    a, training = sweeps.arrays, np.flatnonzero(sweeps.is_training)
    lengths = np.diff(a["offsets"])[training]
    _, cells = find_cells(
        a["laser"][of_training], a["firing"][of_training], a["sweep_fraction"][of_training],
        np.concatenate([[0], np.cumsum(lengths)]), a["firings"][training],
        nominal_firings=sweeps.table.firings_per_turn,
    )  # fmt: skip
    laser, range_m = a["laser"][of_training], a["range_m"][of_training]
    return keep_scans(scans, prior, cells, laser, range_m, a["intensity"][of_training])


def _prove_motion(
    sweeps: Sweeps, returns: TimedReturns, moving: MovingObjects, of_training: np.ndarray, rays: ScanRays
) -> DynamicEvidence:
    """The moving objects, and the static surfaces without their returns.

    Args:
        sweeps: All scans.
        returns: Of the training scans.
        moving: The moving object of each of these returns.
        of_training: (N,) bool, returns of training scans.
        rays: Returns that the static surfaces are built of.
    """
    a = sweeps.arrays
    objects = prove_objects(
        moving, a["origin_m"][of_training], a["direction"][of_training], a["range_m"][of_training],
        sweeps.even_intensity(of_training), returns.time_s, returns.offsets,
    )  # fmt: skip
    return DynamicEvidence(
        static=rays.surfels(FIELD_VOXEL_M, shaped=False),
        objects=choose_flow(objects),
    )
