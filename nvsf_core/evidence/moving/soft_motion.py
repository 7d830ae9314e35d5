"""Flow of objects that bend: how their returns move in the object's frame, besides its rigid motion."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from nvsf_core.geometry.voxels import PLANE_POINTS, planes_around

_STEPS = 12
_MOST_POINTS = 500
"""Most points of a cloud: neighbours on a leg are then still some centimetres apart."""
_SMOOTH_POINTS = 12
_SMOOTH_M = 0.25
"""Distance within which points move alike: about a limb's length."""
_REACH_M, _LAST_REACH_M = 0.6, 0.1
"""A point without a target this near gets little weight; in the first step, and after the last."""
_CARRIED_POINTS = 4
_CARRIED_M = 0.02

Step = Callable[[int, int], np.ndarray]
"""Gives the flow (n, 3) from one cloud to another, by their numbers."""


def flow_between(source_m: np.ndarray, target_m: np.ndarray) -> np.ndarray:
    """Displacement of each of an object's returns from one scan to another.

    Each step moves every return onto the plane through its nearest target return (fitted to 8 neighbours),
    then averages the motion over neighbours within some 25 cm. Returns are not moved along a surface: where
    on it a laser hits does not show how it moves.

    Args:
        source_m: (n, 3) in the object's frame.
        target_m: (m, 3) in the same frame.

    Returns:
        (n, 3) float32 metres; 0 where either has fewer than 8 returns, nearly 0 where no target is near.
    """
    if min(len(source_m), len(target_m)) < PLANE_POINTS:
        return np.zeros((len(source_m), 3), np.float32)
    source, target = _thinned(source_m), _thinned(target_m)
    tree, (_, normal) = cKDTree(target), planes_around(target)
    apart_m, near = cKDTree(source).query(source, min(_SMOOTH_POINTS, len(source)))
    closeness = np.exp(-np.square(apart_m / _SMOOTH_M))
    flow = np.zeros_like(source)
    for step in range(_STEPS):
        off_m, nearest = tree.query(source + flow)
        to_target = target[nearest] - source - flow
        across = np.einsum("ni,ni->n", to_target, normal[nearest])
        reach_m = _LAST_REACH_M + (_REACH_M - _LAST_REACH_M) * (1.0 - step / _STEPS)
        weight = closeness * np.exp(-np.square(off_m / reach_m))[near]
        moved = flow + across[:, None] * normal[nearest]
        flow = np.einsum("nk,nki->ni", weight, moved[near])
        flow /= np.maximum(weight.sum(axis=1), 1e-9)[:, None]
    return flow.astype(np.float32) if len(source) == len(source_m) else carried(source_m, source, flow)


def flow_to(
    clouds: Sequence[np.ndarray], cloud_time_s: np.ndarray, time_s: float, step: Step
) -> list[np.ndarray]:
    """Displacements (n, 3) float32, metres, of the returns of scans from their own instants to a given one.

    Returns of the two scans around the instant move in proportion to time. Returns of earlier and later scans
    first move to the next scan towards the instant, then on as that scan's returns do. Clouds (n, 3), n >= 1,
    are in the object's frame, of scans at ascending instants (k,); before the first or after the last, that
    scan's own instant is used. `step` gives the flow between neighbours in time.
    """
    moved: list[np.ndarray] = [np.zeros((len(cloud), 3), np.float32) for cloud in clouds]
    if len(clouds) < 2:
        return moved
    after = int(np.clip(np.searchsorted(cloud_time_s, time_s), 1, len(clouds) - 1))
    before_s, after_s = cloud_time_s[after - 1 : after + 1]
    share = float(np.clip((time_s - before_s) / (after_s - before_s), 0.0, 1.0))
    moved[after - 1] = share * step(after - 1, after)
    moved[after] = (1.0 - share) * step(after, after - 1)
    for order, towards in ((range(after - 2, -1, -1), 1), (range(after + 1, len(clouds)), -1)):
        for number in order:
            nearer = number + towards
            flow = step(number, nearer)
            moved[number] = flow + carried(clouds[number] + flow, clouds[nearer], moved[nearer])
    return moved


def carried(place_m: np.ndarray, known_m: np.ndarray, flow_m: np.ndarray) -> np.ndarray:
    """Flow (n, 3) float32 at points (n, 3), from the 4 nearest of points (m, 3) with the flow (m, 3)."""
    apart_m, near = cKDTree(known_m).query(place_m, min(_CARRIED_POINTS, len(known_m)))
    apart_m, near = apart_m.reshape(len(place_m), -1), near.reshape(len(place_m), -1)
    weight = 1.0 / np.square(apart_m + _CARRIED_M)
    mean = np.einsum("nk,nki->ni", weight, flow_m[near]) / weight.sum(axis=1)[:, None]
    return np.asarray(mean, np.float32)


def _thinned(cloud_m: np.ndarray) -> np.ndarray:
    """At most 500 points of a cloud (n, 3), evenly chosen, float64."""
    chosen = np.linspace(0, len(cloud_m) - 1, min(len(cloud_m), _MOST_POINTS)).astype(np.int64)
    return cloud_m[chosen].astype(np.float64)
