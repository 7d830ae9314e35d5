"""Registration error between two clouds, without motions that the surfaces cannot determine."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.clouds.open3d_room import load_open3d
from nvsf_core.geometry.se3 import log_so3

LEAST_ACROSS = 0.05
"""Least share of a motion across the surfaces for which it can be measured.

Where neighbours are few, normals are wrong, which alone gives a share of their error's mean squared sine: at
most 0.029 along a tunnel (10 degrees), 0.012 on a plain. The weakest motion in three streets, along the
road, has at least 0.106. The limit lies between."""
_NORMAL_RADIUS_M = 1.0
_NORMAL_POINTS = 30


@dataclass(frozen=True, slots=True, eq=False)
class Slippage:
    """Which small rigid motions surfaces determine.

    A motion is six numbers in metres moved (rms): turns about the points' principal axes, shifts in x, y, z.
    """

    resisted: np.ndarray
    """(6, c) orthonormal columns: motions that are determined."""
    lever_m: np.ndarray
    """(3,) rms distance of the points from each principal axis."""
    axes: np.ndarray
    """(3, 3) principal axes, one a column."""
    free_shifts: np.ndarray
    """(s, 3) unit directions along which shifts are not determined."""
    free_turns: np.ndarray
    """(6 - c - s, 3) unit axes about which turns are not determined."""

    def determined(self, rotation_vector: np.ndarray, shift_m: np.ndarray) -> tuple[float, float]:
        """The determined part of a motion: shift (3,) of the centroid, metres, and turn (3,), radians."""
        motion = np.concatenate([self.axes.T @ rotation_vector * self.lever_m, shift_m])
        kept = self.resisted @ (self.resisted.T @ motion)
        return float(np.linalg.norm(kept[3:])), float(np.linalg.norm(kept[:3] / self.lever_m))


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Result of a registration, without the motions that no surface determines."""

    shift_m: float
    """Shift of the matched points' centroid."""
    turn_deg: float
    """Turn about it."""
    matched: float
    """Share of the source's points with a partner."""
    free_shifts: np.ndarray
    """As `Slippage`'s."""
    free_turns: np.ndarray
    """As `Slippage`'s."""


def register(source_m: np.ndarray, target_m: np.ndarray, max_distance_m: float = 0.5) -> Registration:
    """Register a cloud to another, both placed by their poses, with open3d's point-to-plane ICP.

    Args:
        source_m: (N, 3) metres, in the same frame as `target_m`.
        target_m: (M, 3) metres.
        max_distance_m: Pairs farther apart are not matched.

    Returns:
        The part of the motion that `slippage` finds determined: along a straight tunnel or on a plain, ICP
        slides freely, and how far means nothing.

    Raises:
        MissingLibraryError: open3d cannot be loaded here.
    """
    open3d = load_open3d()
    icp = open3d.pipelines.registration
    centre = target_m.mean(axis=0, dtype=np.float64)
    source, target = (
        open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.astype(np.float64) - centre))
        for cloud in (source_m, target_m)
    )
    around = open3d.geometry.KDTreeSearchParamHybrid(radius=_NORMAL_RADIUS_M, max_nn=_NORMAL_POINTS)
    target.estimate_normals(around)
    estimate = icp.TransformationEstimationPointToPlane()
    result = icp.registration_icp(source, target, max_distance_m, np.eye(4), estimate)
    partner = np.asarray(result.correspondence_set).reshape(-1, 2)[:, 1]
    if len(partner) == 0:
        return Registration(0.0, 0.0, 0.0, np.eye(3), np.eye(3))
    points, normals = np.asarray(target.points)[partner], np.asarray(target.normals)[partner]
    surfaces = slippage(points, normals)
    moved, middle = np.asarray(result.transformation), points.mean(axis=0)
    shift = moved[:3, :3] @ middle + moved[:3, 3] - middle
    shift_m, turn_rad = surfaces.determined(log_so3(moved[:3, :3]), shift)
    return Registration(
        shift_m, float(np.degrees(turn_rad)), float(result.fitness), surfaces.free_shifts, surfaces.free_turns
    )


def slippage(points_m: np.ndarray, normals: np.ndarray) -> Slippage:
    """Which small rigid motions surfaces determine: eigenvectors of the point-to-plane normal matrix.

    With p a point from the centroid, n its normal, a_i the principal axes and l_i the points' rms distance
    from a_i: J = [((p x n) . a_i) / l_i, n] and the matrix is H = sum(J^T J) / N: Gelfand, Ikemoto,
    Rusinkiewicz, Levoy, "Geometrically stable sampling for the ICP algorithm" (2003), there with one length
    for all axes. Every unit vector moves the points by 1 m (rms), so its value v^T H v is the share
    of the squared motion across the surfaces, 0 to 1. Motions below `LEAST_ACROSS` are free.

    Args:
        points_m: (N, 3) points.
        normals: (N, 3) unit normals there.

    Returns:
        Determined and free motions; directions in the points' frame.
    """
    arms = points_m - points_m.mean(axis=0)
    spread = arms.T @ arms / len(arms)
    squared_m2, axes = np.linalg.eigh(np.trace(spread) * np.eye(3) - spread)
    # Points on a line do not move when turned about it: that turn is free at any lever length.
    lever_m = np.sqrt(np.maximum(squared_m2, 1e-6))
    rows = np.concatenate([np.cross(arms, normals) @ axes / lever_m, normals], axis=1)
    matrix = rows.T @ rows / len(rows)
    share, motions = np.linalg.eigh(matrix)
    shift_share, shifts = np.linalg.eigh(matrix[3:, 3:])
    free_shifts = shifts.T[shift_share < LEAST_ACROSS]
    free = motions[:, share < LEAST_ACROSS]
    # A round tunnel turns about its own axis, not through the centroid: a turn with a shift.
    turned = np.linalg.svd(axes @ (free[:3] / lever_m[:, None]))[0].T
    return Slippage(
        resisted=motions[:, share >= LEAST_ACROSS],
        lever_m=lever_m,
        axes=axes,
        free_shifts=_signed(free_shifts),
        free_turns=_signed(turned[: free.shape[1] - len(free_shifts)]),
    )


def _signed(directions: np.ndarray) -> np.ndarray:
    """Directions (k, 3) with their largest component positive: a direction and its opposite are the same."""
    largest = np.take_along_axis(directions, np.abs(directions).argmax(axis=1)[:, None], axis=1)
    found: np.ndarray = directions * np.sign(largest)
    return found
