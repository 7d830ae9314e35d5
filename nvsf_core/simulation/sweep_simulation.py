"""One simulated sweep: every firing answered, the scan as a driver records it, and its range image."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from nvsf_core.evidence.moving.objects import NearObjects
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.evidence.static.surfels import Surfels, candidates_of
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.fields.object_surfaces import object_surfaces
from nvsf_core.fields.surface_batch import surface_batch
from nvsf_core.rendering.answers import RayAnswers
from nvsf_core.rendering.lidar import answer_rays
from nvsf_core.rendering.reproject import NEAR_M, reproject_rays
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable
from nvsf_core.simulation.answered_turn import AnsweredTurn
from nvsf_core.simulation.lidar_rays import SweepRays, sweep_rays
from nvsf_core.simulation.scan import by_lasers, measured_at_rest, put_back_own_vehicle
from nvsf_core.simulation.scene_model import RayRenderer, TurnCorrector
from nvsf_core.simulation.view_plan import SweepPlan

_CHUNK_RAYS = 262144
_FIELD_RAYS = 8192
"""Rays that the field answers at once: what it computes of them stays in the caches."""


@dataclass(frozen=True, slots=True)
class SimulatedSweep:
    """What one sweep of a view gave."""

    points_m: np.ndarray
    """(m, 3) float32 in the sensor's frame at each firing; laser by laser, azimuth ascending."""
    intensity: np.ndarray
    """(m,) float32."""
    laser: np.ndarray
    """(m,) int16."""
    pano_range_m: np.ndarray
    """(66, 1030) float32, 0 = empty: the scan projected with the papers' quirks."""
    pano_intensity: np.ndarray
    """(66, 1030) float32."""
    pano_hit: np.ndarray
    """(66, 1030) float32: probability that any ray of the cell returned."""
    grid: dict[str, np.ndarray]
    """Range, hit probability, intensity, azimuth, elevation (l, f) as recorded, before anything is drawn."""


def field_renderer(
    field: LidarField, surfels: Surfels, moving: NearObjects | None, *, most: int, far_m: float
) -> RayRenderer:
    """Answers by the trained field: corrections of what stays, and of each object in its own frame.

    Args:
        field: Trained.
        surfels: Of what stays.
        moving: The scene's moving objects; None where nothing moves, and nobody is asked about motion.
        most: Candidates a ray.
        far_m: How far a ray is followed.
    """
    places = None if moving is None else field.places(moving.evidence)

    def answer(
        origin_m: np.ndarray, direction: np.ndarray, vote: np.ndarray, time_s: np.ndarray
    ) -> RayAnswers:
        objects = None
        if moving is not None and places is not None:
            there = moving.at(time_s)
            objects = object_surfaces(there, places, origin_m, direction, time_s, near_m=NEAR_M, far_m=far_m)
        parts = []
        for part in _parts(len(vote), _FIELD_RAYS):
            met = None if objects is None else objects.of(np.arange(part.start, part.stop))
            batch = surface_batch(
                surfels, origin_m[part], direction[part], most=most, near_m=NEAR_M, far_m=far_m, objects=met
            )
            parts.append(answer_rays(field, batch, torch.from_numpy(vote[part])))
        return _joined(parts)

    return answer


def evidence_renderer(
    surfels: Surfels, moving: NearObjects | None, *, most: int, far_m: float
) -> RayRenderer:
    """Answers by evidence alone: what stays, and each moving object where it is at a ray's time.

    Arguments as of `field_renderer`.
    """

    def answer(
        origin_m: np.ndarray, direction: np.ndarray, vote: np.ndarray, time_s: np.ndarray
    ) -> RayAnswers:
        objects = () if moving is None else moving.at(time_s)
        return reproject_rays(
            surfels, origin_m, direction, vote, most=most, far_m=far_m, objects=objects, time_s=time_s
        )

    return answer


def image_renderer(surfels: Surfels, *, most: int, far_m: float) -> RayRenderer:
    """Answers by what images prove; how far a ray is stopped is its hit probability.

    Arguments as of `field_renderer`.
    """

    def answer(
        origin_m: np.ndarray, direction: np.ndarray, vote: np.ndarray, time_s: np.ndarray
    ) -> RayAnswers:
        found = candidates_of(surfels, origin_m, direction, most=most, near_m=NEAR_M, far_m=far_m)
        stopped = found.weights.sum(axis=1)
        return reproject_rays(surfels, origin_m, direction, stopped, most=most, far_m=far_m)

    return answer


def highest_rad(table: LaserTable, evidence: SceneEvidence) -> float:
    """Elevation up to which recorded lasers looked; infinite where none of them is known."""
    looked = table.elevation_rad[evidence.lasers.astype(np.int64)]
    return float(looked.max()) if len(looked) else np.inf


def answer_in_chunks(
    render: RayRenderer, origin_m: np.ndarray, direction: np.ndarray, vote: np.ndarray, time_s: np.ndarray
) -> RayAnswers:
    """Answer any number of rays in bounded memory."""
    rays = (origin_m, direction, vote, time_s)
    return _joined([render(*(column[part] for column in rays)) for part in _parts(len(vote), _CHUNK_RAYS)])


def _parts(rays: int, most: int) -> list[slice]:
    """Consecutive parts of so many rays; one, though empty, of none."""
    return [slice(i, min(i + most, rays)) for i in range(0, max(1, rays), most)]


def _joined(parts: list[RayAnswers]) -> RayAnswers:
    if len(parts) == 1:
        return parts[0]
    votes = [part.vote for part in parts if part.vote is not None]
    range_m, hit, intensity = (
        np.concatenate([getattr(p, n) for p in parts]) for n in ("range_m", "hit", "intensity")
    )
    vote = np.concatenate(votes) if len(votes) == len(parts) else None
    return RayAnswers(range_m, hit, intensity, vote)


def simulate_sweep(
    plan: SweepPlan,
    time_s: float,
    evidence: SceneEvidence,
    render: RayRenderer,
    trajectory: Trajectory,
    period_s: float,
    recorded_table: LaserTable,
    votes: int,
    *,
    correct: TurnCorrector | None = None,
    above: RayRenderer | None = None,
    unknown: RayRenderer | None = None,
    as_recorded: bool = False,
) -> SimulatedSweep:
    """Fire one turn of the plan's sensor around `time_s` and record what comes back."""
    rays, answers = fire_sweep(
        plan, time_s, evidence, render, trajectory, period_s, recorded_table, votes, correct=correct,
        above=above, unknown=unknown, as_recorded=as_recorded,
    )  # fmt: skip
    turn = AnsweredTurn.of(rays, answers)
    points, intensity, laser = turn.scan()
    pano = LinearPano(quirks=True)
    pano_range, pano_intensity = pano.project(points, intensity)
    return SimulatedSweep(
        points, intensity, laser, pano_range, pano_intensity, turn.pano_hit(pano), turn.grid()
    )


def fire_sweep(
    plan: SweepPlan,
    time_s: float,
    evidence: SceneEvidence,
    render: RayRenderer,
    trajectory: Trajectory,
    period_s: float,
    recorded_table: LaserTable,
    votes: int,
    *,
    correct: TurnCorrector | None = None,
    above: RayRenderer | None = None,
    unknown: RayRenderer | None = None,
    phase: float = 0.5,
    leave_out_s: float | None = None,
    as_recorded: bool = False,
) -> tuple[SweepRays, RayAnswers]:
    """All rays of one turn of the plan's sensor around `time_s`, answered; the own vehicle is put back.

    `phase` says where the turn starts against its firings; the training scan at `leave_out_s` is silent;
    `as_recorded` and `above` are `SceneModel`'s, and so are `correct` and `unknown`, which are asked where
    the recording sensor is in its own place.
    """
    near = evidence.prior.nearest_scans(time_s, votes, leave_out_s=leave_out_s)
    if plan.is_recorded_sensor:
        lasers, firings = evidence.lasers.astype(np.int64), round(float(evidence.firings[near].mean()))
    else:
        lasers, firings = np.arange(plan.table.laser_count), plan.table.firings_per_turn
    rays = sweep_rays(
        plan.table, lasers, firings, trajectory, time_s, period_s, mount=plan.mount, phase=phase
    )
    voters = lasers if plan.is_recorded_sensor else _similar_lasers(plan.table, recorded_table, evidence)
    vote = evidence.prior.vote_of_turn(voters, rays.fraction[:firings], near).reshape(-1)
    fired_s = time_s + rays.fraction * period_s
    answers = answer_in_chunks(render, rays.origin_m, rays.direction, vote, fired_s)
    if above is not None and not plan.is_recorded_sensor:
        is_above = plan.table.elevation_rad[rays.laser] > highest_rad(recorded_table, evidence)
        asked = np.flatnonzero(is_above & ~np.isfinite(answers.range_m))
        seen = above(rays.origin_m[asked], rays.direction[asked], vote[asked], fired_s[asked])
        answers = _with(answers, asked, seen)
    answers = by_lasers(answers, rays.laser, plan.table, as_recorded=as_recorded)
    is_in_place = plan.is_recorded_sensor and plan.mount is None
    if correct is not None and is_in_place:
        answers = correct(rays, answers, near)
    if unknown is not None and is_in_place:
        answers = ask_unknown(
            answers, unknown, rays.origin_m, rays.direction, vote, fired_s, rays.laser, plan.table
        )
    if is_in_place and not as_recorded:
        own = None if leave_out_s is None else int(np.abs(evidence.prior.time_s - leave_out_s).argmin())
        answers = measured_at_rest(
            answers, rays.laser, rays.fraction, evidence, time_s, trajectory, period_s,
            leave_out=own,
        )  # fmt: skip
    if plan.is_recorded_sensor:
        answers = put_back_own_vehicle(answers, rays, evidence)
    return rays, answers


def ask_unknown(
    answers: RayAnswers,
    unknown: RayRenderer,
    origin_m: np.ndarray,
    direction: np.ndarray,
    vote: np.ndarray,
    time_s: np.ndarray,
    laser: np.ndarray,
    table: LaserTable,
) -> RayAnswers:
    """Let `SceneModel.unknown` answer rays (r, 3) that met nothing though all scans that vote returned there.

    Args:
        answers: In the terms of a stored scan, as `by_lasers` gives them.
        unknown: Of the model.
        origin_m: (r, 3) scene-local.
        direction: (r, 3) unit.
        vote: (r,) share of the nearest scans that returned; what these rays' hits become.
        time_s: (r,) when each ray is fired.
        laser: (r,) of the table; -1 = unknown.
        table: Of the sensor that fires.
    """
    asked = np.flatnonzero(~np.isfinite(answers.range_m) & (vote >= 1.0))
    if len(asked) == 0:
        return answers
    found = unknown(origin_m[asked], direction[asked], vote[asked], time_s[asked])
    return _with(answers, asked, by_lasers(found, laser[asked], table, as_recorded=False))


def _with(answers: RayAnswers, asked: np.ndarray, found: RayAnswers) -> RayAnswers:
    """The same answers, but for rays (k,) `asked`, which another renderer found."""
    columns = {name: getattr(answers, name).copy() for name in ("range_m", "hit", "intensity")}
    for name, column in columns.items():
        column[asked] = getattr(found, name)
    return replace(answers, **columns)


def _similar_lasers(table: LaserTable, recorded: LaserTable, evidence: SceneEvidence) -> np.ndarray:
    """(l,) the recording sensor's laser that looks most nearly along each simulated one."""
    seen = evidence.lasers.astype(np.int64)
    apart = np.abs(table.elevation_rad[:, None] - recorded.elevation_rad[seen][None, :])
    return seen[apart.argmin(axis=1)]
