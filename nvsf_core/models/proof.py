"""Builds the evidence of a drive from its training scans: static surfaces, moving objects, hit priors.

Four choices are made by the errors on scans that are left out: the size of the coarsest voxels, which moving
objects get a flow besides their rigid motion, whether scans are copied where the sensor rested, and which
rays that meet no surface are copied.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.evidence.drop_prior import (
    GAP_CELLS,
    DropPrior,
    build_drop_prior,
    find_cells,
    find_unit_gaps,
    places_apart,
)
from nvsf_core.evidence.moving.detection import find_moving_objects
from nvsf_core.evidence.moving.object_evidence import MovingObjects, ObjectEvidence
from nvsf_core.evidence.moving.objects import prove_objects
from nvsf_core.evidence.moving.visibility import TimedReturns
from nvsf_core.evidence.scene_evidence import LeftOutEvidence, SceneEvidence
from nvsf_core.evidence.stationary_scans import StationaryScans, find_stationary_scans, keep_scans
from nvsf_core.evidence.surfels import COARSEST_M, StaticReturns, Surfels
from nvsf_core.kernels.threads import in_parts
from nvsf_core.models.holdout import choose_copied_share, choose_copying, is_sure, mean_range_error_m
from nvsf_core.recording.drive import LidarRecording, Sweeps, training_returns
from nvsf_core.rendering.reproject import reproject_rays
from nvsf_core.sensors.sweep import sweep_rays

_VALIDATION_SCANS = 2
_FEWEST_FOR_ALL = 6
"""With fewer training scans one is left out, not two: the field must not learn from half of them."""
_FEWEST_SCANS = 3
"""With fewer training scans none can be spared for validation."""
_RAYS_A_SCAN = 20_000
_WORST_M = 1.0
"""Largest error of a ray in the score of a voxel size."""
_MOST_VALIDATED = 12
"""Most scans of an object that are left out, one after the other."""
_VALIDATED_FIRST = 4
"""If the flow does not help on these, the others are not tried: most objects are rigid, a score is slow."""
_FEWEST_VALIDATED = 6
_FEWEST_RETURNS = 20
_RESOLVED_M = 30.0
"""Farther away the rows of 64 lasers are over 20 cm apart on an object, too coarse for limbs."""
_WORST_ON_OBJECT_M = 0.5
"""Largest error of a ray in the score of a flow."""
_GAP_SCANS = 12
"""Most scans in which gaps of the recorded unit are sought."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanRays:
    """Returns of the training scans, without the own vehicle's, scene-local."""

    origin_m: np.ndarray
    """(n, 3) float32."""
    direction: np.ndarray
    """(n, 3) float32, unit."""
    range_m: np.ndarray
    """(n,) float32."""
    intensity: np.ndarray
    """(n,) float32."""
    scan: np.ndarray
    """(n,) int64 number of the scan."""
    is_static: np.ndarray
    """(n,) bool: not of a moving object."""

    def static(self) -> StaticReturns:
        """The static scene's returns."""
        return StaticReturns.of(self.origin_m, self.direction, self.range_m, self.intensity, self.is_static)

    def of(self, chosen: np.ndarray) -> "ScanRays":
        """The chosen (n,) returns."""
        return ScanRays(**{name: getattr(self, name)[chosen] for name in self.__slots__})


@dataclass(frozen=True, slots=True)
class VoxelChoice:
    """The coarsest voxels that were tried: their errors, and the surfels of all but the validation scans."""

    errors_m: dict[float, float]
    """For each edge, the mean absolute range error along the validation scans' rays, metres; a ray counts at
    most 1 m, and 1 m if nothing is met."""
    coarsest_m: float
    """The edge with the smallest error."""
    left_out: LeftOutEvidence
    """In voxels of this edge at most."""


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
    choice = choose_coarsest(
        rays, training, unidentified=training[prior.is_unidentified], far_m=float(sweeps.table.max_range_m)
    )
    coarsest_m = COARSEST_M[0] if choice is None else choice.coarsest_m
    static = rays.static()
    of_field, shown = static.field(coarsest_m), static.shown(coarsest_m)
    evidence = SceneEvidence(
        static=of_field,
        prior=prior,
        lasers=lasers[lasers >= 0].astype(np.int16),
        firings=firings.astype(np.int32),
        own_range_m=a["own_vehicle_range_m"],
        own_intensity=a["own_vehicle_intensity"],
        objects=() if moving.is_static else _prove_motion(sweeps, returns, moving, of_training),
        stationary=_stationary_scans(sweeps, of_training, prior),
        rendered=shown,
        left_out=None if choice is None else choice.left_out,
        unit_gaps=_unit_gaps(sweeps, prior, shown),
    )  # fmt: skip
    tried: dict[str, Scalar] = {"coarsest_voxel_m": coarsest_m}
    for edge_m, error_m in ({} if choice is None else choice.errors_m).items():
        tried[f"left_out_error_m_up_to_{1000 * edge_m:.0f}_mm"] = error_m
    rested, stationary = choose_copying(LidarRecording(sweeps=sweeps, evidence=evidence))
    chosen, unmet = choose_copied_share(rested)
    return chosen.evidence, tried | stationary | unmet


def _unit_gaps(sweeps: Sweeps, prior: DropPrior, surfels: Surfels) -> np.ndarray | None:
    """Gaps of the recorded unit, see `find_unit_gaps`, by rays of some scans through static surfels."""
    _, position_m = sweeps.trajectory.at(prior.time_s)
    scans = places_apart(position_m, _GAP_SCANS)
    scans = scans[~prior.is_unidentified[scans]]
    lasers = np.arange(sweeps.table.laser_count)
    is_met = np.zeros((len(scans), len(lasers), GAP_CELLS), bool)
    for number, scan in enumerate(scans):
        rays = sweep_rays(
            sweeps.table, lasers, GAP_CELLS, sweeps.trajectory, float(prior.time_s[scan]), sweeps.period_s,
            clock=sweeps.clock_near(float(prior.time_s[scan])),
        )  # fmt: skip
        # Whether a ray meets anything, its first surface tells.
        rendered = reproject_rays(
            surfels, rays.origin_m, rays.direction, np.ones(len(rays.laser), np.float32),
            most=1, far_m=float(sweeps.table.max_range_m),
        )  # fmt: skip
        is_met[number] = np.isfinite(rendered.range_m).reshape(rays.shape)
    return find_unit_gaps(prior, scans, is_met)


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
    sweeps: Sweeps, returns: TimedReturns, moving: MovingObjects, of_training: np.ndarray
) -> tuple[ObjectEvidence, ...]:
    """The moving objects, with a flow where it helps.

    Args:
        sweeps: All scans.
        returns: Of the training scans.
        moving: The moving object of each of these returns.
        of_training: (N,) bool, returns of training scans.
    """
    a = sweeps.arrays
    objects = prove_objects(
        moving, a["origin_m"][of_training], a["direction"][of_training], a["range_m"][of_training],
        sweeps.even_intensity(of_training), returns.time_s, returns.offsets,
    )  # fmt: skip
    return choose_flow(objects)


def choose_coarsest(
    rays: ScanRays, training: np.ndarray, *, unidentified: np.ndarray, far_m: float
) -> VoxelChoice | None:
    """Score the coarsest voxels on one or two training scans that the surfels are built without.

    Edges are tried from the shortest on; the first that is worse than one before it ends the search.

    Args:
        rays: Of the training scans.
        training: (n,) numbers of these scans.
        unidentified: (s,) numbers of scans that are never left out, because their lasers are unknown.
        far_m: How far a ray is followed.

    Returns:
        None if there are fewer than three scans or no static return to compare.
    """
    scans = np.setdiff1d(np.flatnonzero(np.bincount(rays.scan)), unidentified)
    if len(scans) < _FEWEST_SCANS:
        return None
    count = _VALIDATION_SCANS if len(scans) >= _FEWEST_FOR_ALL else 1
    validation = scans[(np.arange(1, count + 1) * len(scans)) // (count + 1)]
    is_validation = np.isin(rays.scan, validation)
    asked = np.flatnonzero(is_validation & rays.is_static)
    if len(asked) == 0:
        return None
    most = count * _RAYS_A_SCAN
    asked = asked[np.unique(np.linspace(0, len(asked) - 1, most).astype(np.int64))]
    others = rays.of(~is_validation).static()
    errors_m, shown = dict[float, float](), dict[float, Surfels]()
    for edge_m in COARSEST_M:
        shown[edge_m] = others.shown(edge_m)
        errors_m[edge_m] = mean_range_error_m(
            shown[edge_m], rays.origin_m[asked], rays.direction[asked], rays.range_m[asked],
            far_m=far_m, worst_m=_WORST_M,
        )  # fmt: skip
        if errors_m[edge_m] > min(errors_m.values()):
            break
    best_m = min(errors_m, key=lambda edge_m: errors_m[edge_m])
    left_out = LeftOutEvidence(np.searchsorted(training, validation), others.field(best_m), shown[best_m])
    return VoxelChoice(errors_m, best_m, left_out)


def choose_flow(objects: tuple[ObjectEvidence, ...]) -> tuple[ObjectEvidence, ...]:
    """The same objects; with a flow those whose range error on left-out scans it surely lowers.

    The flow of a rigid object is noise and makes it worse, so it gets none.
    """

    def chosen(number: int) -> ObjectEvidence:
        one = objects[number]
        return one.with_flow() if _bends(one) else one

    return tuple(in_parts(chosen, len(objects)))


def _bends(one: ObjectEvidence) -> bool:
    validation = _left_out_of_object(one)
    if len(validation) < _FEWEST_VALIDATED:
        return False
    # Shuffled evenly, so that the first few are spread over the drive.
    order = np.argsort(np.arange(len(validation)) * 0.618 % 1.0)
    gains = [_gain_m(one, int(scan)) for scan in validation[order[:_VALIDATED_FIRST]]]
    if np.mean(gains) <= 0.0:
        return False
    gains += [_gain_m(one, int(scan)) for scan in validation[order[_VALIDATED_FIRST:]]]
    return is_sure(gains)


def _left_out_of_object(one: ObjectEvidence) -> np.ndarray:
    """Numbers (j,) of at most 12 scans with 20 near returns of the object or more, not its first or last."""
    rays = one.rays
    near = rays.scan[rays.is_hit & (rays.range_m < _RESOLVED_M)]
    validation = np.array([s for s in one.path.scan[1:-1] if (near == s).sum() >= _FEWEST_RETURNS], np.int64)
    return validation[
        np.linspace(0, len(validation) - 1, min(len(validation), _MOST_VALIDATED)).astype(np.int64)
    ]


def _gain_m(one: ObjectEvidence, scan: int) -> float:
    """By how much a flow lowers the mean range error on a scan, rendered from the other scans."""
    time_s = float(one.path.time_s[np.searchsorted(one.path.scan, scan)])
    others = one.of_scans(one.scans_near(time_s, leave_out=scan))
    asked = one.rays.is_hit & (one.rays.scan == scan) & (one.rays.range_m < _RESOLVED_M)
    return _error_m(others, one, asked, time_s) - _error_m(others.with_flow(), one, asked, time_s)


def _error_m(shown: ObjectEvidence, one: ObjectEvidence, asked: np.ndarray, time_s: float) -> float:
    """Mean absolute range error of `shown` along the rays of `one` that `asked` (n,) bool selects."""
    surfels = shown.surfels_from(shown.path.scan, time_s)
    if surfels is None:
        return _WORST_ON_OBJECT_M
    rays = one.rays.of(asked)
    return mean_range_error_m(
        surfels, rays.origin_m, rays.direction, rays.range_m,
        far_m=2.0 * _RESOLVED_M, worst_m=_WORST_ON_OBJECT_M,
    )  # fmt: skip
