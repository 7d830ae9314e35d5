"""Trains the paper's scene flow: its point clouds, its loss, and training of the flow alone."""

from collections.abc import Callable, Sequence
from dataclasses import asdict

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from nvsf_core.errors import DataError, ShapeError
from nvsf_core.fields.flow import FlowField
from nvsf_core.losses.chamfer import flow_magnitude, scene_flow_loss
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.recipe.residual import TrainingSpec
from nvsf_core.training.adam import Adam
from nvsf_core.training.loop import Part, TrainingState, train


def flow_loss(
    flow: FlowField,
    recipe: PaperRecipe,
    clouds: Sequence[np.ndarray],
    frame: np.ndarray,
    row: int,
    t: float,
    generator: torch.Generator,
) -> LossBreakdown:
    """L_flow from one frame to its neighbours before and after, if there; no term if its cloud is empty.

    Args:
        flow: Is trained.
        recipe: Points a cloud, weights, and the unit cube's bound.
        clouds: Each (m, 3) float32, scaled units, without ground.
        frame: (k,) frame coordinate of each cloud.
        row: Number of the cloud that is moved.
        t: Its time in [0, 1].
        generator: Samples points of a cloud with more than `recipe.flow.points`.
    """
    device = next(flow.parameters()).device
    here = _sampled(clouds[row], recipe.flow.points, generator, device)
    if not len(here):
        return total_loss({}, {})
    forward, backward = flow(here / (2.0 * recipe.slips.bound) + 0.5, t)
    after, before = (
        _sampled(clouds[int(found[0])], recipe.flow.points, generator, device)
        if len(found := np.flatnonzero(frame == frame[row] + step))
        else None
        for step in (1.0, -1.0)
    )
    terms = {"flow": scene_flow_loss(here, forward, backward, after, before)}
    if recipe.losses.flow_magnitude:
        terms["flow_magnitude"] = flow_magnitude(forward, backward)
    # The paper adds the distances to both neighbours.
    return total_loss(terms, asdict(recipe.losses), ("flow",))


def train_flow(
    recipe: PaperRecipe,
    clouds: Sequence[np.ndarray],
    frame: np.ndarray,
    count: int,
    steps: int,
    seed: int,
    say: Callable[[str], None],
) -> TrainingState:
    """Train the flow field alone: each step moves the cloud of one random frame.

    Args:
        recipe: Its `flow`, `optimiser` (rate and decay) and `slips.bound` are used.
        clouds: Each (m, 3) float32, scaled units, without ground.
        frame: (k,) frame coordinates 0..count - 1 of the clouds.
        count: Frames of the scene, those without a cloud included.
        steps: Optimiser steps.
        seed: Of the weights and of all samples.
        say: Prints a line of progress, every few seconds.

    Returns:
        The state after the last step; its `model` is the `FlowField`.

    Raises:
        DivergedError: The loss or a weight is not finite.
    """
    spec, generator = recipe.optimiser, torch.Generator().manual_seed(seed)
    flow = FlowField(recipe.flow, generator)
    groups = [{"params": list(flow.parameters()), "lr": spec.head_rate, "initial_lr": spec.head_rate}]
    optimiser = Adam(groups, betas=(0.9, 0.99), eps=1e-15)
    state = TrainingState(flow, optimiser, generator)
    last = max(1, count - 1)

    def step(_: int, sampler: torch.Generator) -> list[Part]:
        row = int(torch.randint(len(clouds), (1,), generator=sampler))
        return [lambda: [flow_loss(flow, recipe, clouds, frame, row, float(frame[row]) / last, sampler)]]

    loop = TrainingSpec(
        steps=steps, rays=recipe.flow.points, final_share=spec.final_share, checkpoint_s=1e9,
    )  # fmt: skip
    train(state, loop, step, lambda tensors, facts: None, say)
    return state


def _sampled(cloud: np.ndarray, most: int, generator: torch.Generator, device: torch.device) -> Tensor:
    """At most `most` points of a cloud (m, 3), without replacement."""
    points = torch.from_numpy(cloud)
    if len(points) > most:
        points = points[torch.randperm(len(points), generator=generator)[:most]]
    return points.to(device)


NEAREST_M, FARTHEST_M = 1.0, 60.0
"""Bounds of the distance of kept points from the sensor; the authors': 0.75 times the longest range."""
LOWEST_M, HIGHEST_M = -2.5, 4.0
"""Bounds of the height of kept points over the sensor, excluded."""
OWN_VEHICLE_M = (2.0, 1.0, 2.0)
"""Half edges of the box around the sensor that holds the own vehicle: forward, left, up."""

_NEIGHBOURS = 64
_OUTLIER_SIGMAS = 3.0
_THIN_ABOVE = 16_384
"""In larger clouds neighbours are sought in a random quarter of the points, and a quarter as many."""
_THIN = 4

_PLANES = 6
_INLIER_M = 0.15
_GROUND_BELOW_M = -1.0
"""Ground lies lower than this in the sensor's frame (KITTI-360's sensor is 1.73 m above it)."""
_LEAST_UPRIGHT = np.cos(np.deg2rad(20.0))
"""Least z of a ground plane's normal: streets are not steeper than 20 degrees."""
_HYPOTHESES = 128
_COUNTED = 4096
"""Points that hypotheses are compared on; the best is then fitted to all."""
_LEAST_SHARE = 0.02
"""Least share of the low points on a plane."""
_FLAT_SHARE = 0.45
"""Least share of a plane's inliers within a third of the inlier distance. In a slab through walls and cars a
third are; on a street nearly all."""


def flow_cloud(
    points_m: np.ndarray, sensor_to_scene: np.ndarray, centre_m: np.ndarray, generator: np.random.Generator
) -> np.ndarray:
    """The returns of one scan that the flow is fitted to.

    Points too far, too high, too low or of the own vehicle are removed, then stray points, then the ground,
    then stray points again, because without ground others are stray.

    Args:
        points_m: (n, 3) float64, scene-local.
        sensor_to_scene: (4, 4) rigid pose of the sensor.
        centre_m: (3,) scene-local point that becomes the origin, so that float32 is exact to a micrometre.
        generator: Samples hypotheses of the ground; the same state gives the same cloud.

    Returns:
        (m, 3) float32, metres from `centre_m` along the scene's axes, in the order of `points_m`; m may be 0.

    Raises:
        ShapeError: An array has another shape.
        DataError: A point is not finite.
    """
    if points_m.ndim != 2 or points_m.shape[1] != 3 or sensor_to_scene.shape != (4, 4):
        raise ShapeError(
            f"flow_cloud: expected points (n, 3) and a pose (4, 4), found {points_m.shape} and "
            f"{sensor_to_scene.shape}"
        )
    if not np.isfinite(points_m).all():
        bad = int((~np.isfinite(points_m).all(axis=1)).sum())
        raise DataError(f"flow_cloud: expected finite points, found {bad} of {len(points_m)} not; drop them")
    in_sensor = (points_m.astype(np.float64) - sensor_to_scene[:3, 3]) @ sensor_to_scene[:3, :3]
    kept = np.flatnonzero(_is_in_reach(in_sensor))
    kept = kept[~is_stray(in_sensor[kept], generator)]
    kept = kept[~is_ground(in_sensor[kept], generator)]
    kept = kept[~is_stray(in_sensor[kept], generator)]
    return (points_m[kept] - centre_m).astype(np.float32)


def is_stray(points_m: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Whether each point of (n, 3) is a statistical outlier (Rusu et al. 2008), (n,) bool.

    The mean distance of an outlier to its 64 nearest points is above the mean of that over the cloud by more
    than three standard deviations. In clouds above 16,384 points the 16 nearest in a random quarter are used;
    with fewer than 65 points, all others.
    """
    n = len(points_m)
    thin = _THIN if n > _THIN_ABOVE else 1
    count = min(_NEIGHBOURS // thin, n - 1)
    if count < 1:
        return np.zeros(n, bool)
    # Sorted: neighbours in the file are neighbours in space, and so in memory.
    chosen = np.sort(generator.permutation(n)[: n // thin])
    # One more than wanted: a chosen point finds itself first, another does without its last.
    distance_m = cKDTree(points_m[chosen]).query(points_m, count + 1)[0].reshape(n, count + 1)
    is_chosen = np.zeros(n, bool)
    is_chosen[chosen] = True
    to_nearest = np.where(is_chosen, distance_m[:, 1:].mean(axis=1), distance_m[:, :-1].mean(axis=1))
    return to_nearest > to_nearest.mean() + _OUTLIER_SIGMAS * to_nearest.std()


def is_ground(points_m: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Whether each point of (n, 3), in the sensor's frame, lies on one of up to six nearly level planes.

    Each plane is the one of 128 random hypotheses with the most points within 0.15 m, fitted again to those;
    its points are removed before the next is sought. The search ends with a plane that has too few points, or
    whose points are spread over its whole thickness, as those of upright objects are.
    """
    ground = np.zeros(len(points_m), bool)
    low = np.flatnonzero(points_m[:, 2] < _GROUND_BELOW_M)
    least = max(3.0, _LEAST_SHARE * len(low))
    for _ in range(_PLANES):
        left = low[~ground[low]]
        if len(left) < least:
            break
        plane = _most_supported_plane(points_m[left], generator)
        if plane is None:
            break
        off_plane_m = np.abs(points_m[left] @ plane[:3] + plane[3])
        inlier = off_plane_m < _INLIER_M
        if inlier.sum() < least or (off_plane_m < _INLIER_M / 3.0).sum() < _FLAT_SHARE * inlier.sum():
            break
        ground[left[inlier]] = True
    return ground


def _is_in_reach(points_m: np.ndarray) -> np.ndarray:
    distance_m = np.linalg.norm(points_m, axis=1)
    in_reach: np.ndarray = (distance_m >= NEAREST_M) & (distance_m <= FARTHEST_M)
    in_reach &= (points_m[:, 2] > LOWEST_M) & (points_m[:, 2] < HIGHEST_M)
    return in_reach & ~(np.abs(points_m) < np.array(OWN_VEHICLE_M)).all(axis=1)


def _most_supported_plane(points_m: np.ndarray, generator: np.random.Generator) -> np.ndarray | None:
    """(4,) unit normal and offset of the nearly level plane with the most inliers; None if there is none."""
    counted = points_m[generator.integers(len(points_m), size=min(_COUNTED, len(points_m)))]
    corners = points_m[generator.integers(len(points_m), size=(_HYPOTHESES, 3))]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    level = np.abs(normal[:, 2]) > _LEAST_UPRIGHT * length
    if not level.any():
        return None
    normal, corner = normal[level] / length[level, None], corners[level, 0]
    offset = -(normal * corner).sum(axis=1)
    counts = (np.abs(counted @ normal.T + offset) < _INLIER_M).sum(axis=0)
    best = int(counts.argmax())
    return _fitted(points_m, np.append(normal[best], offset[best]))


def _fitted(points_m: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Fit a plane (4,) to its inliers by least squares, twice."""
    for _ in range(2):
        inliers = points_m[np.abs(points_m @ plane[:3] + plane[3]) < _INLIER_M]
        if len(inliers) < 3:
            break
        middle = inliers.mean(axis=0)
        normal = np.linalg.svd((inliers - middle).T @ (inliers - middle))[0][:, 2]
        plane = np.append(normal, -normal @ middle)
    return plane
