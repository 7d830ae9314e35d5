"""Finds moving objects in the training returns, without labels and without learning.

What moves in a scan is clustered; clusters are linked to tracks; a track's path gathers the whole object.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from nvsf_core.evidence.moving.merged_paths import merge_paths
from nvsf_core.evidence.moving.object_evidence import MovingObjects
from nvsf_core.evidence.moving.path_fitting import LONGEST_FRAME_S, Path, carry_on, solve_path
from nvsf_core.evidence.moving.path_gaps import fill_gaps
from nvsf_core.evidence.moving.visibility import (
    SEED,
    STATIC,
    AboveGround,
    TimedReturns,
    build_ground,
    classify_returns,
)
from nvsf_core.evidence.moving.whole_objects import LEAST_SCANS, whole_objects
from nvsf_core.kernels.threads import in_parts

ABOVE_GROUND_M = 0.25
"""Lower returns are taken as ground and cannot move."""
_HIGHEST_M = 5.0
_FARTHEST_M = 80.0
_NEAREST_M = 1.0
_VOXEL_M = 0.25
_LINK_M = 0.5
_LEAST_SEEDS = 8
_FEWEST_SEEDS = 3
_USUAL_SPACING_RAD = 0.007
"""Angle between neighbouring lasers of the 64-laser sensor for which all numbers of returns are given."""
_SEED_SHARE = 0.4
_SEEDS_PER_STATIC = 2.0
_LONGEST_M = 20.0
"""An articulated bus; what is longer is a wall or a hedge whose visible side changes."""
_NEW_GATE_M = 2.2
"""Metres per frame that an object seen in one scan may have moved."""
_GATE_M = 0.8
"""Metres per frame that an object may be away from its prediction."""
_HARD_M_S2 = 4.0
"""Braking, or a bend."""
_FASTEST_M_S = 45.0
"""A first step longer than `_MOST_COST` is believed up to this speed, if the next scan goes on with it."""
_ALIKE_SIZE = 1.5
"""Such steps are between clusters whose sizes differ by at most this factor."""
_MOST_COST = 1.6
_SIZE_COST_M = 0.3
_LONGEST_GAP_FRAMES, _LONGEST_GAP_SCANS = 3.5, 1.5
_LEAST_MOVED_M = 0.5
_LEAST_SPEED_M = 0.04
"""Metres per frame; slower motion is noise."""
_TRACK_WITHIN_M = 60.0
_LEAST_OF_TRACK, _FEWEST_OF_TRACK = 10.0, 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Cluster:
    """One probably moving object in one scan."""

    scan: int
    members: np.ndarray
    """(k,) int64 indices of its returns among all returns."""
    time_s: float
    """Mean time of its returns."""
    centre_m: np.ndarray
    """(3,) float64 mean of its returns, scene-local metres."""
    size_m: float
    """Diagonal of its axis-aligned box."""
    nearest_m: float
    """Range of its nearest return."""


def laser_density(spacing_rad: float) -> float:
    """Returns that a sensor gets from an object, relative to a 64-laser sensor; at most 1."""
    return min(1.0, _USUAL_SPACING_RAD / spacing_rad)


def pull_together(
    point_m: np.ndarray, above_sensor_m: np.ndarray, range_m: np.ndarray, spacing_rad: float
) -> np.ndarray:
    """Points (m, 3) moved towards the sensor's height until rows of neighbouring lasers can be linked.

    Args:
        point_m: (m, 3) scene-local, metres.
        above_sensor_m: (m,) heights above the sensor.
        range_m: (m,) ranges from the sensor.
        spacing_rad: Angle between neighbouring lasers.
    """
    pulled = point_m.copy()
    pulled[:, 2] -= above_sensor_m * (1.0 - np.minimum(1.0, _LINK_M / (spacing_rad * range_m)))
    return pulled


def cluster_scan(
    scan: int, returns: TimedReturns, above_ground: AboveGround, range_m: np.ndarray, spacing_rad: float
) -> list[Cluster]:
    """Clusters of a scan's returns above the ground that probably move.

    Voxels are linked to others within half a metre, but not those that are mostly static.

    Args:
        scan: Number of the scan.
        returns: All training returns.
        above_ground: Those that may move, with their labels.
        range_m: (N,) ranges of all returns.
        spacing_rad: Angle between neighbouring lasers.
    """
    index, label = above_ground.of_scan(scan)
    least_seeds = max(_FEWEST_SEEDS, _LEAST_SEEDS * laser_density(spacing_rad))
    if (label == SEED).sum() < least_seeds:
        return []
    point_m, range_m = returns.point_m[index], range_m[index]
    group = _groups(pull_together(point_m, returns.recorded_m[index, 2], range_m, spacing_rad), label)
    count = int(group.max(initial=-1)) + 1
    seeds = np.bincount(group[(label == SEED) & (group >= 0)], minlength=count)
    static = np.bincount(group[(label == STATIC) & (group >= 0)], minlength=count)
    size = np.bincount(group[group >= 0], minlength=count)
    moving = (seeds >= least_seeds) & (seeds >= _SEED_SHARE * size) & (seeds >= _SEEDS_PER_STATIC * static)
    clusters = []
    for chosen in np.flatnonzero(moving):
        rows = np.flatnonzero(group == chosen)
        points = point_m[rows].astype(np.float64)
        extent = np.ptp(points, axis=0)
        if np.hypot(extent[0], extent[1]) > _LONGEST_M:
            continue
        clusters.append(
            Cluster(
                scan=scan,
                members=index[rows],
                time_s=float(returns.time_s[index[rows]].mean()),
                centre_m=points.mean(axis=0),
                size_m=float(np.linalg.norm(extent)),
                nearest_m=float(range_m[rows].min()),
            )
        )
    return clusters


def _groups(point_m: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Number (m,) of the linked group of each point (m, 3); -1 in mostly static voxels."""
    cell = np.floor(point_m / _VOXEL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    extent = cell.max(axis=0) + 1
    keys, voxel = np.unique(np.ravel_multi_index(cell.T, extent), return_inverse=True)
    static_share = np.bincount(voxel, weights=label == STATIC) / np.bincount(voxel)
    kept = np.flatnonzero(static_share <= 0.5)
    group = np.full(len(keys), -1)
    if len(kept):
        centre = np.stack(np.unravel_index(keys[kept], extent), axis=1) * _VOXEL_M
        pairs = cKDTree(centre).query_pairs(_LINK_M + 1e-6, output_type="ndarray")
        links = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(kept),) * 2)
        group[kept] = connected_components(links, directed=False)[1]
    return group[voxel]


@dataclass(slots=True, eq=False)
class Track:
    """One object's clusters, one per scan that saw it, ascending in time."""

    clusters: list[Cluster]

    def times_s(self) -> np.ndarray:
        """(k,) mean times of the clusters' returns."""
        return np.array([cluster.time_s for cluster in self.clusters])

    def centres_m(self) -> np.ndarray:
        """(k, 3) means of the clusters' returns, scene-local metres."""
        return np.array([cluster.centre_m for cluster in self.clusters])

    def predict(self, time_s: float) -> np.ndarray:
        """Centre (3,) predicted for a time at the constant velocity of the last three clusters."""
        last = self.clusters[-3:]
        if len(last) == 1:
            return last[0].centre_m
        span_s = last[-1].time_s - last[0].time_s
        velocity = (last[-1].centre_m - last[0].centre_m) / span_s
        return last[-1].centre_m + velocity * (time_s - last[-1].time_s)


def link_tracks(
    clusters_by_scan: list[list[Cluster]], frame_s: float, density: float = 1.0, *, scan_step_s: float = 0.0
) -> list[Track]:
    """Join clusters scan by scan, greedily by cost, and keep the tracks that have moved.

    Args:
        clusters_by_scan: Of the scans, ascending in time.
        frame_s: Seconds from frame to frame of the recording.
        density: From `laser_density`: scales the number of returns that a track needs.
        scan_step_s: Seconds from scan to scan, where more frames are held out than between most scans.
    """
    longest_s = max(_LONGEST_GAP_FRAMES * frame_s, _LONGEST_GAP_SCANS * scan_step_s)
    tracks: list[Track] = []
    for scan, clusters in enumerate(clusters_by_scan):
        if not clusters:
            continue
        later = next((one for one in clusters_by_scan[scan + 1 :] if one), [])
        now_s = min(cluster.time_s for cluster in clusters)
        alive = [t for t in tracks if now_s - t.clusters[-1].time_s < longest_s]
        options = sorted(
            (cost, i, k)
            for i, track in enumerate(alive)
            for k, cluster in enumerate(clusters)
            if (cost := _cost(track, cluster, frame_s, later)) < _MOST_COST
        )
        used_tracks, used_clusters = set(), set()
        for _, i, k in options:
            if i in used_tracks or k in used_clusters:
                continue
            used_tracks.add(i)
            used_clusters.add(k)
            alive[i].clusters.append(clusters[k])
        tracks += [Track([cluster]) for k, cluster in enumerate(clusters) if k not in used_clusters]
    return [track for track in tracks if _has_moved(track, frame_s, density)]


def _cost(track: Track, cluster: Cluster, frame_s: float, later: list[Cluster]) -> float:
    """Distance from the prediction plus a cost of a changed size; infinite outside the gate.

    `later` are the clusters of the next scan that has any.
    """
    last = track.clusters[-1]
    frames = (cluster.time_s - last.time_s) / frame_s
    if frames <= 0.0:
        return np.inf
    distance = float(np.linalg.norm(cluster.centre_m - track.predict(cluster.time_s)))
    is_new = len(track.clusters) == 1
    gate = (_NEW_GATE_M if is_new else _gate_m_a_frame(frame_s)) * max(frames, 1.0)
    ratio = max(cluster.size_m, 0.1) / max(last.size_m, 0.1)
    cost = distance / max(frames, 1.0) + _SIZE_COST_M * abs(float(np.log(ratio)))
    if distance <= gate and cost < _MOST_COST:
        return cost
    farthest_m = _FASTEST_M_S * (cluster.time_s - last.time_s)
    if is_new and distance < farthest_m and _is_followed(last, cluster, later, frame_s):
        # After all slower ones, the nearer first.
        return _MOST_COST - 1e-6 * (farthest_m - distance)
    return np.inf


def _is_followed(first: Cluster, second: Cluster, later: list[Cluster], frame_s: float) -> bool:
    """Whether a cluster of the next scan lies where the step from the first to the second goes on to."""
    velocity = (second.centre_m - first.centre_m) / (second.time_s - first.time_s)
    gate_m = _gate_m_a_frame(frame_s)

    def goes_on(third: Cluster) -> bool:
        after_s = third.time_s - second.time_s
        away_m = float(np.linalg.norm(third.centre_m - second.centre_m - velocity * after_s))
        return after_s > 0.0 and away_m <= gate_m * max(after_s / frame_s, 1.0) and _are_alike(second, third)

    return _are_alike(first, second) and any(map(goes_on, later))


def _gate_m_a_frame(frame_s: float) -> float:
    """`_GATE_M`, and what braking or a bend adds where frames are rarer than of a sensor of 10 Hz."""
    return _GATE_M + _HARD_M_S2 * frame_s * max(0.0, frame_s - LONGEST_FRAME_S)


def _are_alike(one: Cluster, other: Cluster) -> bool:
    small, large = sorted((max(one.size_m, 0.1), max(other.size_m, 0.1)))
    return large <= _ALIKE_SIZE * small


def _has_moved(track: Track, frame_s: float, density: float) -> bool:
    if len(track.clusters) < LEAST_SCANS:
        return False
    first, last = track.clusters[0], track.clusters[-1]
    moved_m = float(np.linalg.norm(last.centre_m - first.centre_m))
    frames = (last.time_s - first.time_s) / frame_s
    returns = np.mean([len(cluster.members) for cluster in track.clusters])
    return bool(
        moved_m > _LEAST_MOVED_M
        and moved_m > _LEAST_SPEED_M * frames
        and min(cluster.nearest_m for cluster in track.clusters) < _TRACK_WITHIN_M
        and returns >= max(_FEWEST_OF_TRACK, _LEAST_OF_TRACK * density)
    )


def start_path(track: Track) -> Path:
    """A path through the means of a track's clusters, all with the yaw from the first to the last."""
    centre = track.centres_m()
    ahead = centre[-1] - centre[0]
    heading = np.full((len(centre), 1), np.arctan2(ahead[1], ahead[0]))
    return Path(
        scan=[cluster.scan for cluster in track.clusters],
        members=[cluster.members for cluster in track.clusters],
        time_s=track.times_s(),
        pose=np.concatenate([centre, heading], axis=1),
    )


def find_moving_objects(returns: TimedReturns) -> MovingObjects:
    """Find the moving objects, their paths and their returns. Deterministic.

    None are found in fewer than three scans, without returns, or where nothing moves.
    """
    nothing = MovingObjects((), np.full(len(returns.point_m), -1, np.int32))
    if returns.scan_count < LEAST_SCANS or len(returns.point_m) == 0:
        return nothing
    range_m = np.linalg.norm(returns.recorded_m, axis=1)
    above_ground = _classify(returns, range_m)
    spacing_rad = returns.laser_spacing_rad
    density = laser_density(spacing_rad)
    clusters = [
        cluster_scan(scan, returns, above_ground, range_m, spacing_rad) for scan in range(returns.scan_count)
    ]
    step_s = float(np.median(np.diff(returns.scan_time_s)))
    paths = list(map(start_path, link_tracks(clusters, returns.frame_s, density, scan_step_s=step_s)))

    def follow(number: int) -> None:
        solve_path(paths[number], returns)
        carried = carry_on(paths[number], returns, above_ground)
        if fill_gaps(paths[number], returns, above_ground) or carried:
            solve_path(paths[number], returns)

    in_parts(follow, len(paths))
    merged = merge_paths(paths, returns)
    return whole_objects(merged, returns, above_ground, density) if merged else nothing


def _classify(returns: TimedReturns, range_m: np.ndarray) -> AboveGround:
    """The returns that may move, with their labels; `range_m` (N,) are the ranges of all."""
    within = ~returns.is_own_vehicle & (range_m > _NEAREST_M) & (range_m < _FARTHEST_M)
    if not within.any():
        return AboveGround(
            np.zeros(0, np.int64), np.zeros(0, np.int8), np.zeros(returns.scan_count + 1, np.int64)
        )
    height = build_ground(returns.point_m[within]).above(returns.point_m)
    index = np.flatnonzero(within & (height > ABOVE_GROUND_M) & (height < _HIGHEST_M))
    return AboveGround(index, classify_returns(returns, index), np.searchsorted(index, returns.offsets))
