"""Joins clusters of successive scans into tracks of the same object."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.moving.clusters import Cluster

_NEW_GATE_M = 2.2
"""Metres per frame that an object seen in one scan may have moved."""
_GATE_M = 0.8
"""Metres per frame that an object may be away from its prediction."""
_MOST_COST = 1.6
_SIZE_COST_M = 0.3
_LONGEST_GAP_FRAMES = 3.5
_LEAST_SCANS = 3
_LEAST_MOVED_M = 0.5
_LEAST_SPEED_M = 0.04
"""Metres per frame; slower motion is noise."""
_NEAREST_M = 60.0
_LEAST_RETURNS, _FEWEST_RETURNS = 10.0, 4.0


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


def link_tracks(clusters_by_scan: list[list[Cluster]], frame_s: float, density: float = 1.0) -> list[Track]:
    """Join clusters scan by scan, greedily by cost, and keep the tracks that have moved.

    `density`, from `laser_density`, scales the number of returns that a track needs.
    """
    tracks: list[Track] = []
    for clusters in clusters_by_scan:
        if not clusters:
            continue
        now_s = min(cluster.time_s for cluster in clusters)
        alive = [t for t in tracks if now_s - t.clusters[-1].time_s < _LONGEST_GAP_FRAMES * frame_s]
        options = sorted(
            (cost, i, k)
            for i, track in enumerate(alive)
            for k, cluster in enumerate(clusters)
            if (cost := _cost(track, cluster, frame_s)) < _MOST_COST
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


def _cost(track: Track, cluster: Cluster, frame_s: float) -> float:
    """Distance from the prediction plus a cost of a changed size; infinite outside the gate."""
    last = track.clusters[-1]
    frames = (cluster.time_s - last.time_s) / frame_s
    if frames <= 0.0:
        return np.inf
    distance = float(np.linalg.norm(cluster.centre_m - track.predict(cluster.time_s)))
    gate = (_NEW_GATE_M if len(track.clusters) == 1 else _GATE_M) * max(frames, 1.0)
    if distance > gate:
        return np.inf
    ratio = max(cluster.size_m, 0.1) / max(last.size_m, 0.1)
    return distance / max(frames, 1.0) + _SIZE_COST_M * abs(float(np.log(ratio)))


def _has_moved(track: Track, frame_s: float, density: float) -> bool:
    if len(track.clusters) < _LEAST_SCANS:
        return False
    first, last = track.clusters[0], track.clusters[-1]
    moved_m = float(np.linalg.norm(last.centre_m - first.centre_m))
    frames = (last.time_s - first.time_s) / frame_s
    returns = np.mean([len(cluster.members) for cluster in track.clusters])
    return bool(
        moved_m > _LEAST_MOVED_M
        and moved_m > _LEAST_SPEED_M * frames
        and min(cluster.nearest_m for cluster in track.clusters) < _NEAREST_M
        and returns >= max(_FEWEST_RETURNS, _LEAST_RETURNS * density)
    )
