"""Collects moving objects' rays in their own frames, and finds objects' surfaces along rays to render."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock

import numpy as np

from nvsf_core.evidence.moving.object_evidence import (
    OBJECT_VOXEL_M,
    MovingObject,
    MovingObjects,
    NearHitPriors,
    ObjectEvidence,
    ObjectHitPriors,
    ObjectRays,
)
from nvsf_core.evidence.surfels import Candidates, Surfels, candidates_of, weighted_median_index
from nvsf_core.kernels.bounds import MovingBounds, rays_into_bounds

_MOST_CANDIDATES = 12
_MARGIN_M = 0.1
_STEPS_A_FRAME = 8
"""Instants per frame at which objects' surfels are built; an object that bends moves 2 cm between them."""
_KEPT = 16
"""Instants and places whose objects are kept: a sweep asks for two, and up to eight are rendered at once."""
_KEPT_SURFELS = 256
"""Objects whose surfels are kept: what the bonnet mirrors is seen from elsewhere, but mostly by the same
scans."""
_SOME = 256
"""Rays from which a sweep's origins are estimated: to decimetres, and their extent to a twentieth."""
_BEYOND_SOME = 1.2
"""By how much the extent of all origins may be larger, in any case."""


SurfelsBuilder = Callable[[ObjectEvidence, np.ndarray, float], Surfels | None]
"""Gives `ObjectEvidence.surfels_from` of an object, or the same found before."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectSurfels:
    """A moving object about some instant: its path, and its surfels in its own frame."""

    number: int
    """Its number among the scene's objects."""
    path: MovingObject
    surfels: Surfels
    hit_priors: NearHitPriors
    """Its nearest scans, in which hit priors are looked up."""

    def hit_prior(
        self, found: Candidates, origin_m: np.ndarray, direction: np.ndarray, time_s: np.ndarray
    ) -> np.ndarray:
        """Hit prior (r,) float32: share of its nearest scans with a return where the rays end on it.

        Rays (r, 3) are scene-local, fired at times (r,); each has at least one surface, and ends on the
        weighted median one. It is looked up at the ray's end and not at a voxel's mean, because windows have
        edges finer than a voxel.
        """
        median = weighted_median_index(found.weights)
        range_m = found.range_m[np.arange(len(median)), median]
        point = origin_m + direction * range_m[:, None]
        return self.hit_priors.share(self.path.to_object(point.astype(np.float64), time_s))


def prove_objects(
    moving: MovingObjects,
    origin_m: np.ndarray,
    direction: np.ndarray,
    range_m: np.ndarray,
    intensity: np.ndarray,
    time_s: np.ndarray,
    offsets: np.ndarray,
) -> tuple[ObjectEvidence, ...]:
    """Evidence of each moving object: its path and the training rays that cross its bounds.

    Args:
        moving: The objects, and which of the N training returns are theirs.
        origin_m: (N, 3) scene-local metres, of the training rays in the same order.
        direction: (N, 3) unit, scene-local axes.
        range_m: (N,) metres to the return.
        intensity: (N,) of the return, 0..1.
        time_s: (N,) instant of the ray.
        offsets: (n + 1,) int: scan k's rays are offsets[k] .. offsets[k + 1] - 1.
    """
    voxel_m = OBJECT_VOXEL_M / np.sqrt(moving.density)
    found = []
    for number, path in enumerate(moving.objects):
        parts = []
        for scan in path.scan:
            part = slice(int(offsets[scan]), int(offsets[scan + 1]))
            inside, origin_o, direction_o = _crossing(path, origin_m[part], direction[part], time_s[part])
            parts.append((part.start + inside, origin_o, direction_o, np.full(len(inside), scan, np.int32)))
        index = np.concatenate([part[0] for part in parts])
        rays = ObjectRays(
            origin_m=np.concatenate([part[1] for part in parts]),
            direction=np.concatenate([part[2] for part in parts]),
            range_m=range_m[index].astype(np.float32),
            intensity=intensity[index].astype(np.float32),
            is_hit=moving.object_id[index] == number,
            scan=np.concatenate([part[3] for part in parts]),
        )
        found.append(ObjectEvidence(path, rays, voxel_m))
    return tuple(found)


def objects_at(
    evidence: tuple[ObjectEvidence, ...],
    time_s: float,
    hit_priors: ObjectHitPriors,
    *,
    leave_out: int | None = None,
    from_m: np.ndarray | None = None,
    build: SurfelsBuilder = ObjectEvidence.surfels_from,
) -> tuple[ObjectSurfels, ...]:
    """The objects that are there about an instant, each built from its nearest scans.

    Neither their surfels nor their paths use the training scan `leave_out`, as if it were held out.

    Args:
        evidence: Of all objects.
        time_s: The instant.
        hit_priors: Of all training scans.
        leave_out: Number of a training scan.
        from_m: (3,) where they are seen from, scene-local, metres; where no near scan saw an object from
            there, others that did are added. None = from the recorded path, as always with `leave_out`.
        build: Surfels of an object from some of its scans at a time.
    """
    there, looked_up = [], []
    for number, one in enumerate(evidence):
        path = one.path.without(leave_out)
        spare = np.array([time_s - path.frame_s, time_s, time_s + path.frame_s])
        if not path.is_there(spare).any():
            continue
        scans = one.scans_near(time_s, leave_out=leave_out)
        lag_s = _lag_s(one.path, scans, hit_priors)
        if from_m is not None and leave_out is None:
            scans = one.scans_towards(time_s, from_m, scans)
        surfels = build(one, scans, time_s + lag_s)
        if surfels is not None:
            there.append((number, path, surfels))
            looked_up.append((path, scans))
    return tuple(
        ObjectSurfels(*one, own_priors)
        for one, own_priors in zip(there, hit_priors.near(looked_up, time_s), strict=True)
    )


class NearObjects:
    """Moving objects about the times of rays; built once for a sweep whose rays come in parts.

    Several threads may ask at once, each for a sweep of its own.
    """

    def __init__(
        self,
        evidence: tuple[ObjectEvidence, ...],
        hit_priors: ObjectHitPriors,
        *,
        leave_out: int | None = None,
    ) -> None:
        """Objects are built without the training scan `leave_out`."""
        self.evidence = evidence
        self._hit_priors = hit_priors
        self._leave_out = leave_out
        self._built: dict[tuple[float, ...], tuple[ObjectSurfels, ...]] = {}
        self._lock = Lock()
        self._kept = lru_cache(_KEPT_SURFELS)(_surfels_from)

    def at(self, time_s: np.ndarray, origin_m: np.ndarray) -> tuple[ObjectSurfels, ...]:
        """The objects about the median of rays' times (r,), rounded to eighths of a frame; none without rays.

        They are seen from the mean of the origins (r, 3), scene-local, rounded to metres.
        """
        if len(time_s) == 0 or not self.evidence:
            return ()
        frame_s = self.evidence[0].path.frame_s
        # The median times and mean origins of a sweep's parts are near each other.
        instant = round(_STEPS_A_FRAME * float(np.median(time_s)) / frame_s)
        from_m = np.round(_some(origin_m).mean(axis=0, dtype=np.float64))
        about = (instant, *from_m.tolist())
        found = self._built.get(about)
        if found is None:
            found = objects_at(
                self.evidence, instant * frame_s / _STEPS_A_FRAME, self._hit_priors,
                leave_out=self._leave_out, from_m=from_m, build=self._surfels_from,
            )  # fmt: skip
            with self._lock:
                if len(self._built) >= _KEPT:
                    del self._built[next(iter(self._built))]
                self._built[about] = found
        return found

    def _surfels_from(self, one: ObjectEvidence, scans: np.ndarray, time_s: float) -> Surfels | None:
        return self._kept(one, tuple(scans.tolist()), time_s)


def _surfels_from(one: ObjectEvidence, scans: tuple[int, ...], time_s: float) -> Surfels | None:
    return one.surfels_from(np.array(scans, np.int32), time_s)


def candidates_on(
    one: ObjectSurfels,
    origin_m: np.ndarray,
    direction: np.ndarray,
    time_s: np.ndarray,
    *,
    near_m: float,
    far_m: float,
) -> tuple[np.ndarray, Candidates]:
    """Which rays meet an object at their own times, and on which of its surfaces they may end.

    Args:
        one: The object.
        origin_m: (r, 3) scene-local, metres.
        direction: (r, 3) unit, scene-local axes.
        time_s: (r,) instants of the rays.
        near_m: Least range.
        far_m: Greatest range.

    Returns:
        (k,) int64 ascending numbers of the rays that meet it, and candidates (k, 12) with the numbers of the
        object's own voxels.
    """
    inside, origin_o, direction_o = _crossing(one.path, origin_m, direction, time_s)
    own = candidates_of(one.surfels, origin_o, direction_o, most=_MOST_CANDIDATES, near_m=near_m, far_m=far_m)
    met = own.voxel[:, 0] >= 0
    found = Candidates(own.range_m[met], own.voxel[met], own.opacity[met], own.cosine[met])
    return inside[met], found


def merge_objects(
    found: Candidates,
    rays: np.ndarray,
    first_voxel: int,
    objects: tuple[ObjectSurfels, ...],
    met: list[tuple[np.ndarray, Candidates]],
) -> Candidates:
    """Merge objects' surfaces into a static scene's candidates, by range.

    Args:
        found: Candidates (m, k) of the static surfels along some rays of a batch.
        rays: (m,) int64 ascending numbers of those rays in the batch.
        first_voxel: Number given to the first object's first voxel; the others follow.
        objects: From `objects_at`.
        met: For each object, the result of `candidates_on` for the batch; its rays must all be in `rays`.

    Returns:
        Candidates of the same shape; where a ray has more than k, the farthest are left out.
    """
    range_m, voxel, opacity, cosine = (
        found.range_m.copy(), found.voxel.copy(), found.opacity.copy(), found.cosine.copy()
    )  # fmt: skip
    number = first_voxel
    for one, (ray, own) in zip(objects, met, strict=True):
        first_voxel, number = number, number + one.surfels.count
        rows = np.searchsorted(rays, ray)
        own_voxel = np.where(own.voxel >= 0, own.voxel + first_voxel, -1)
        voxels = np.concatenate([voxel[rows], own_voxel], axis=1)
        ranges = np.concatenate([range_m[rows], own.range_m], axis=1)
        order = np.argsort(np.where(voxels >= 0, ranges, np.inf), axis=1, kind="stable")[:, : voxel.shape[1]]
        voxel[rows] = np.take_along_axis(voxels, order, axis=1)
        range_m[rows] = np.take_along_axis(ranges, order, axis=1)
        for target, mine in ((opacity, own.opacity), (cosine, own.cosine)):
            target[rows] = np.take_along_axis(np.concatenate([target[rows], mine], axis=1), order, axis=1)
    return Candidates(range_m, voxel, opacity, cosine)


def _lag_s(path: MovingObject, scans: np.ndarray, hit_priors: ObjectHitPriors) -> float:
    """How long after a sweep's instant the recording sensor hits an object: the median of some scans (k,).

    A sensor mounted the other way round hits it up to half a frame earlier or later.
    """
    met_s = path.time_s[np.searchsorted(path.scan, scans)]
    return float(np.median(met_s - hit_priors.prior.time_s[scans])) if len(scans) else 0.0


def _some(column: np.ndarray) -> np.ndarray:
    """At most 256 rows of an array, evenly chosen."""
    return column[:: len(column) // _SOME + 1]


def _crossing(
    path: MovingObject, origin_m: np.ndarray, direction: np.ndarray, time_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which rays (k,) int64 of (r, 3) cross the object's bounds at their own times (r,).

    Also returns their origins and directions (k, 3) float32 in its frame.
    """
    if len(time_s) == 0:
        return np.zeros(0, np.int64), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    low_m, high_m = path.low_m - _MARGIN_M, path.high_m + _MARGIN_M
    axis, least_cosine = _cone(path, 0.5 * float(np.linalg.norm(high_m - low_m)), origin_m, time_s)
    box = MovingBounds(axis, least_cosine, *path.there_s, path.time_s, path.pose, low_m, high_m)
    return rays_into_bounds(origin_m, direction, time_s, box)


def _cone(
    path: MovingObject, radius_m: float, origin_m: np.ndarray, time_s: np.ndarray
) -> tuple[np.ndarray, float]:
    """Cone with all rays, (r, 3) origins at times (r,), that meet a ball around the object.

    Its apex is in the middle of the origins and the object in the middle of its way: the ball is enlarged by
    what either is off there at most.

    Returns:
        Axis (3,) float64, and the least cosine of a ray's angle to it.
    """
    start_s, end_s = np.clip([time_s.min(), time_s.max()], *path.there_s)
    on_way_s = path.time_s[(path.time_s > start_s) & (path.time_s < end_s)]
    pose = path.matrix_at(np.concatenate([[0.5 * (start_s + end_s), start_s, end_s], on_way_s]))
    centre_m = pose[:, :3, :3] @ (0.5 * (path.low_m + path.high_m)) + pose[:, :3, 3]
    some_m = _some(origin_m).astype(np.float64)
    first_m, last_m = some_m.min(axis=0), some_m.max(axis=0)
    reach_m = radius_m + np.linalg.norm(centre_m - centre_m[0], axis=1).max()
    reach_m += _BEYOND_SOME * 0.5 * np.linalg.norm(last_m - first_m)
    towards_m = centre_m[0] - 0.5 * (first_m + last_m)
    distance_m = float(np.linalg.norm(towards_m))
    if distance_m <= reach_m:
        return np.zeros(3), -1.0
    return towards_m / distance_m, float(np.sqrt(1.0 - (reach_m / distance_m) ** 2))
