"""A moving object: its rigid path, its rays in its own frame, its surfels at an instant, hit priors, box."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.evidence.moving.soft_motion import flow_between, flow_to
from nvsf_core.evidence.surfels import Surfels, build_surfels
from nvsf_core.geometry.se3 import invert_pose, pose_from_parts, rotation_of
from nvsf_core.kernels.grid_hit_priors import FiringLasers, share_of_scans
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable

OBJECT_VOXEL_M = 0.1
"""Voxel edge for 64 lasers; with fewer lasers, larger ones hold about as many returns each."""
NEAREST_SCANS = 4
"""Scans that an object's surfels are built from: more add nothing, and blur what bends, such as legs."""
_SEEN_WITHIN_DEG = 15.0
"""From directions farther than this from those of its nearest scans an object shows sides unknown to them."""
_BEYOND_FRAMES = 1.5
"""Frames before its first and after its last scan in which an object is still shown, at constant velocity."""


@dataclass(frozen=True, slots=True, eq=False)
class MovingObject:
    """One moving object and its rigid path; in its own frame z is up and x is ahead at first."""

    scan: np.ndarray
    """(k,) int32 ascending: numbers of the training scans that saw it."""
    time_s: np.ndarray
    """(k,) float64 mean times of its returns in them."""
    pose: np.ndarray
    """(k, 4) float64 x, y, z in scene-local metres and yaw in radians, unwrapped, at `time_s`."""
    frame_s: float
    """Seconds from frame to frame."""
    low_m: np.ndarray
    """(3,) metres: lower corner of its returns in its own frame."""
    high_m: np.ndarray
    """(3,) metres: their upper corner."""

    def pose_at(self, time_s: np.ndarray) -> np.ndarray:
        """Poses (r, 4) of x, y, z, yaw at times (r,): linear between scans, constant velocity beyond."""
        time_s = np.asarray(time_s, np.float64)
        if len(self.time_s) == 1:
            return np.repeat(self.pose, len(time_s), axis=0)
        before = np.clip(np.searchsorted(self.time_s, time_s) - 1, 0, len(self.time_s) - 2)
        start_s = self.time_s[before]
        share = (time_s - start_s) / (self.time_s[before + 1] - start_s)
        return self.pose[before] + share[:, None] * (self.pose[before + 1] - self.pose[before])

    def without(self, scan: int | None) -> "MovingObject":
        """The path without one of its scans; itself where that scan did not see the object."""
        kept = self.scan != scan
        if kept.all():
            return self
        return replace(self, scan=self.scan[kept], time_s=self.time_s[kept], pose=self.pose[kept])

    @property
    def there_s(self) -> tuple[float, float]:
        """First and last instant, 1.5 frames beyond the path's scans; an empty interval without scans."""
        if len(self.time_s) == 0:
            return np.inf, -np.inf
        spare_s = _BEYOND_FRAMES * self.frame_s
        return float(self.time_s[0] - spare_s), float(self.time_s[-1] + spare_s)

    def is_there(self, time_s: np.ndarray) -> np.ndarray:
        """Whether (r,) bool times (r,) lie within `there_s`."""
        first_s, last_s = self.there_s
        return np.asarray((time_s >= first_s) & (time_s <= last_s))

    def matrix_at(self, time_s: np.ndarray) -> np.ndarray:
        """Object-to-scene poses (r, 4, 4) at times (r,)."""
        pose = self.pose_at(time_s)
        return pose_from_parts(_about_z(pose[:, 3]), pose[:, :3])

    def to_object(self, point_m: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        """Scene-local points (r, 3), each at its own time (r,), moved to the object's frame, float64."""
        pose = self.pose_at(time_s)
        return self.turn_to_object(point_m - pose[:, :3], pose[:, 3])

    @staticmethod
    def turn_to_object(vector: np.ndarray, yaw_rad: np.ndarray) -> np.ndarray:
        """Scene-local vectors (r, 3) in the axes of an object with the yaws `yaw_rad` (r,)."""
        cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
        x, y, z = vector[:, 0], vector[:, 1], vector[:, 2]
        return np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class MovingObjects:
    """All moving objects of a drive; object i of `objects` has the id i."""

    objects: tuple[MovingObject, ...]
    """Largest first."""
    object_id: np.ndarray
    """(N,) int32 of every training return; -1 = not on a moving object."""
    density: float = 1.0
    """From `laser_density`."""

    @property
    def is_static(self) -> bool:
        """Nothing moves."""
        return len(self.objects) == 0


def _about_z(yaw_rad: np.ndarray) -> np.ndarray:
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    zero, one = np.zeros_like(cosine), np.ones_like(cosine)
    rows = ([cosine, -sine, zero], [sine, cosine, zero], [zero, zero, one])
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


@dataclass(frozen=True, slots=True, eq=False)
class ObjectRays:
    """n training rays that cross an object's bounds, in its frame at each ray's own time."""

    origin_m: np.ndarray
    """(n, 3) float32 metres."""
    direction: np.ndarray
    """(n, 3) float32 unit."""
    range_m: np.ndarray
    """(n,) float32 metres to the return, which may lie on the object, before it or behind it."""
    intensity: np.ndarray
    """(n,) float32 of the return, 0..1."""
    is_hit: np.ndarray
    """(n,) bool: the return is the object's."""
    scan: np.ndarray
    """(n,) int32 ascending: number of the training scan."""

    def of(self, chosen: np.ndarray) -> "ObjectRays":
        """Chosen rays: their numbers (m,), or (n,) bool."""
        return ObjectRays(*(getattr(self, name)[chosen] for name in self.__slots__))

    def point_m(self, chosen: np.ndarray) -> np.ndarray:
        """Returns (m, 3) in the object's frame of chosen rays: their numbers (m,), or (n,) bool."""
        return self.origin_m[chosen] + self.direction[chosen] * self.range_m[chosen, None]


@dataclass(frozen=True, slots=True, eq=False)
class ObjectEvidence:
    """One moving object: its path and all rays that crossed its bounds."""

    path: MovingObject
    rays: ObjectRays
    voxel_m: float = OBJECT_VOXEL_M
    """Edge of its surfels' voxels, metres."""
    flow_m: np.ndarray | None = None
    """(n, 2, 3) float32 metres, in its frame: displacement of each return to the path's scan before and to
    the scan after; 0 for rays without a return on it, and where there is no such scan. None = it is rigid."""

    def of_scans(self, scans: np.ndarray) -> "ObjectEvidence":
        """The same object from the scans (k,) alone, in the same frame and bounds, without a flow."""
        path = self.path
        kept = np.isin(path.scan, scans)
        return ObjectEvidence(
            replace(path, scan=path.scan[kept], time_s=path.time_s[kept], pose=path.pose[kept]),
            self.rays.of(self._rows_of(scans)), self.voxel_m,
        )  # fmt: skip

    def with_flow(self) -> "ObjectEvidence":
        """The same object with a flow, for one that bends."""
        flow_m = np.zeros((len(self.rays.scan), 2, 3), np.float32)
        rows = [self._rows_of(np.array([scan])) for scan in self.path.scan]
        returns = [own[self.rays.is_hit[own]] for own in rows]
        points = [self.rays.point_m(own) for own in returns]
        for before in range(len(points) - 1):
            flow_m[returns[before], 1] = flow_between(points[before], points[before + 1])
            flow_m[returns[before + 1], 0] = flow_between(points[before + 1], points[before])
        return replace(self, flow_m=flow_m)

    def scans_near(self, time_s: float, *, leave_out: int | None = None) -> np.ndarray:
        """Its at most 4 scans nearest to a time, (k,) int32, without the training scan `leave_out`."""
        scans = self.path.scan[np.argsort(np.abs(self.path.time_s - time_s), kind="stable")]
        return (scans if leave_out is None else scans[scans != leave_out])[:NEAREST_SCANS]

    def scans_towards(self, time_s: float, from_m: np.ndarray, scans: np.ndarray) -> np.ndarray:
        """Scans (k,) and, if it is seen from elsewhere than by them, the at most 4 that saw it from there.

        An instant that is seen from a place, the mean origin (3,) of rays, scene-local metres, where the
        sensor came later shows sides that were recorded then. None of its other scans is left out.
        """
        if len(scans) == 0:
            return scans
        middle_m = 0.5 * (self.path.low_m + self.path.high_m)
        first = np.searchsorted(self.rays.scan, self.path.scan)
        met = first < len(self.rays.scan)
        met[met] = self.rays.scan[first[met]] == self.path.scan[met]
        seen_from = _unit(self.rays.origin_m[first[met]] - middle_m)
        wanted = _unit(self.path.to_object(from_m[None].astype(np.float64), np.array([time_s])) - middle_m)[0]
        cosine = seen_from @ wanted
        scan = self.path.scan[met]
        known = cosine[np.isin(scan, scans)].max(initial=-1.0)
        if known >= np.cos(np.deg2rad(_SEEN_WITHIN_DEG)):
            return scans
        nearest = np.argsort(-cosine, kind="stable")[:NEAREST_SCANS]
        return np.union1d(scans, scan[nearest[cosine[nearest] > known]])

    def rays_at(self, scans: np.ndarray, time_s: float) -> ObjectRays:
        """The m rays of the scans (k,); its returns are moved by the flow to where they are at an instant."""
        used = self._rows_of(scans)
        rays = self.rays.of(used)
        if self.flow_m is None:
            return rays
        flow_m = self.flow_m[used]
        returns = [np.flatnonzero(rays.is_hit & (rays.scan == scan)) for scan in np.unique(rays.scan)]
        returns = [rows for rows in returns if len(rows)]
        points = [rays.point_m(rows) for rows in returns]
        places = np.searchsorted(self.path.scan, [rays.scan[rows[0]] for rows in returns])

        def step(first: int, second: int) -> np.ndarray:
            # Flow is stored between neighbouring scans only: here one between them was left out.
            if abs(places[second] - places[first]) != 1:
                return flow_between(points[first], points[second])
            return flow_m[returns[first], int(second > first)]

        origin_m = rays.origin_m.copy()
        moved = flow_to(points, self.path.time_s[places], time_s, step)
        for rows, shift_m in zip(returns, moved, strict=True):
            origin_m[rows] += shift_m
        return replace(rays, origin_m=origin_m)

    def surfels_from(self, scans: np.ndarray, time_s: float) -> Surfels | None:
        """Its surfels at an instant, in its frame, from the scans (k,); None without a return on it."""
        rays = self.rays_at(scans, time_s)
        if not rays.is_hit.any():
            return None
        return build_surfels(
            rays.origin_m, rays.direction, rays.range_m, rays.intensity,
            voxel_m=self.voxel_m, is_surface=rays.is_hit, joined=False,
        )  # fmt: skip

    def _rows_of(self, scans: np.ndarray) -> np.ndarray:
        """Numbers (m,) int64 ascending of its rays in the scans (k,)."""
        ordered = np.sort(scans)
        starts = np.searchsorted(self.rays.scan, ordered, side="left")
        ends = np.searchsorted(self.rays.scan, ordered, side="right")
        rows = [np.arange(start, end) for start, end in zip(starts, ends, strict=True)]
        return np.concatenate([np.zeros(0, np.int64), *rows])


def _unit(vector: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) of length 1."""
    return vector / np.linalg.norm(vector, axis=1, keepdims=True)


_FORGOTTEN_FRAMES = 1.5
"""A scan's weight falls by a factor e in so many frames, because the view of windows and edges changes."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectHitPriors:
    """Everything needed to look up whether a training scan had a return at a point on an object."""

    prior: DropPrior
    """Of the training scans, in the numbering that objects use."""
    lasers: np.ndarray
    """(l,) lasers that ever returned, from the top."""
    trajectory: Trajectory
    table: LaserTable
    elevation_correction_rad: float

    def near(
        self, objects: Sequence[tuple[MovingObject, np.ndarray]], time_s: float
    ) -> tuple["NearHitPriors", ...]:
        """Hit priors of objects about a time, each from the identified ones of some scans (k,)."""
        is_unidentified = self.prior.is_unidentified
        paths = [path for path, _ in objects]
        known = [scans[~is_unidentified[scans]] for _, scans in objects]
        own_s = [path.time_s[np.searchsorted(path.scan, s)] for path, s in zip(paths, known, strict=True)]
        # One lookup for all objects costs as much as for one.
        to_sensor = invert_pose(pose_from_parts(*self.trajectory.at(np.concatenate([*own_s, np.zeros(0)]))))
        ends = np.cumsum([len(instants) for instants in own_s], dtype=np.int64)
        return tuple(
            NearHitPriors(
                self,
                scans.astype(np.int64),
                np.exp(-np.abs(instants - time_s) / (_FORGOTTEN_FRAMES * path.frame_s)),
                to_sensor[end - len(instants) : end] @ path.matrix_at(instants),
            )
            for path, scans, instants, end in zip(paths, known, own_s, ends, strict=True)
        )


@dataclass(frozen=True, slots=True, eq=False)
class NearHitPriors:
    """Hit priors at any point of an object, from k scans that saw it."""

    hit_priors: ObjectHitPriors
    scans: np.ndarray
    """(k,) int64 numbers of the training scans."""
    weight: np.ndarray
    """(k,) float64 above 0."""
    object_to_sensor: np.ndarray
    """(k, 4, 4) float64: pose of the object in each scan's sensor frame."""

    def share(self, place_o: np.ndarray) -> np.ndarray:
        """Weighted share (v,) float32 of the scans with a return at points (v, 3) in the object's frame.

        1 where there are no scans: all that is known of the object are its returns.
        """
        if len(self.scans) == 0:
            return np.ones(len(place_o), np.float32)
        hit_priors, table, prior = self.hit_priors, self.hit_priors.table, self.hit_priors.prior
        # Copies: for the read-only arrays of a sensor's own table the kernel would be compiled once more.
        lasers = FiringLasers(
            hit_priors.elevation_correction_rad, hit_priors.lasers.astype(np.int64),
            table.elevation_rad.copy(), table.vertical_offset_m.copy(), table.horizontal_offset_m.copy(),
            (table.phase_steps - table.firing_shift_steps) * table.step_rad,
        )  # fmt: skip
        return share_of_scans(
            np.ascontiguousarray(place_o, np.float64), self.object_to_sensor, self.weight, lasers, self.scans,
            prior.fraction, prior.is_hit,
        )  # fmt: skip


_STEP_DEG = 1.0
_WITHIN_PERCENT = (0.5, 99.5)
"""Returns beyond these percentiles along an axis are mistakes in range or of the object's outline."""
_LEAST_SIDE_M = 0.1


def boxes_on_way(one: ObjectEvidence) -> np.ndarray:
    """(k, 4, 4) from the unit cube, +-0.5, to the scene-local frame, metres, at each time of its path."""
    box = smallest_box(one.rays.point_m(one.rays.is_hit), way_ahead(one.path))
    return one.path.matrix_at(one.path.time_s) @ box


def way_ahead(path: MovingObject) -> np.ndarray:
    """(2,) x and y of the direction of travel in the object's own frame, of any length.

    It is the sum of the path's steps as the object itself makes them: of one that turned, the way from first
    to last tells nothing.
    """
    yaw_rad = 0.5 * (path.pose[:-1, 3] + path.pose[1:, 3])
    steps_m = path.turn_to_object(np.diff(path.pose[:, :3], axis=0), yaw_rad)
    return np.asarray(steps_m.sum(axis=0)[:2])


def smallest_box(point_m: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """The upright box of least area, seen from above, around points.

    Args:
        point_m: (n, 3) metres, z up; n >= 1.
        ahead: (2,) direction of travel, x and y, of any length: the box's x axis is its axis nearest to it.

    Returns:
        (4, 4) from the unit cube, +-0.5, to the points' frame, metres; no side is shorter than 10 cm.
    """

    def area_m2(yaw_deg: float) -> float:
        low, high = np.percentile(
            point_m[:, :2] @ rotation_of(yaw_deg, 0.0, 0.0)[:2, :2], _WITHIN_PERCENT, axis=0
        )
        return float(np.prod(high - low))

    # One direction at a time: a lorry has a million returns.
    best_deg = min(np.arange(0.0, 90.0, _STEP_DEG).tolist(), key=area_m2)
    towards_deg = float(np.rad2deg(np.arctan2(ahead[1], ahead[0])))
    axes = rotation_of(best_deg + 90.0 * round((towards_deg - best_deg) / 90.0), 0.0, 0.0)
    low_m, high_m = np.percentile(point_m @ axes, _WITHIN_PERCENT, axis=0)
    box = np.eye(4)
    box[:3, :3] = axes * np.maximum(high_m - low_m, _LEAST_SIDE_M)
    box[:3, 3] = axes @ (0.5 * (low_m + high_m))
    return box
