"""Chamfer distance of two point clouds, and the losses made of it: of a batch of rays, and of scene flow.

Under the loss of scene flow, a frame's moved cloud has to fit the clouds of the neighbouring frames.
"""

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from nvsf_core.errors import ShapeError
from nvsf_core.numerics import require_finite

_CHUNK_PAIRS = 1 << 26
"""Most distances in memory at once on CUDA: 256 MiB of float32."""


def squared_nearest_distances(points: Tensor, others: Tensor) -> tuple[Tensor, Tensor]:
    """Squared distance of each point to the nearest other point, and of each other to the nearest point.

    Differentiable in both clouds; the choice of the nearest point is a constant. On a tie, any of them.

    Args:
        points: (n, 3), n >= 1.
        others: (m, 3), m >= 1, same device, unit and frame.

    Returns:
        min_j |p_i - q_j|^2 (n,) and min_i |q_j - p_i|^2 (m,), squared unit of the inputs.

    Raises:
        ShapeError: Not two clouds of at least one point.
        DivergedError: A coordinate is not finite.
    """
    for name, cloud in (("points", points), ("others", others)):
        if cloud.ndim != 2 or cloud.shape[1] != 3 or len(cloud) == 0:
            raise ShapeError(f"nearest distances: expected {name} (n >= 1, 3), found {tuple(cloud.shape)}")
        require_finite(f"nearest distances, {name}", cloud)
    nearest_other, nearest_point = _nearest(points, others), _nearest(others, points)
    return (
        ((points - others[nearest_other]) ** 2).sum(dim=1),
        ((others - points[nearest_point]) ** 2).sum(dim=1),
    )


def chamfer_distance(points: Tensor, others: Tensor) -> Tensor:
    """CD = mean_i min_j |p_i - q_j|^2 + mean_j min_i |q_j - p_i|^2, a scalar, squared unit of the inputs.

    Eq. 4 of the paper (CD), with each cloud's own number of points for its 1/K. Arguments and errors as
    in `squared_nearest_distances`.
    """
    to_others, to_points = squared_nearest_distances(points, others)
    return to_others.mean() + to_points.mean()


def ray_batch_chamfer(direction: Tensor, rendered_range_m: Tensor, true_range_m: Tensor) -> Tensor:
    """Half of the sum of both nearest squared distances (r,), m2, of rendered and recorded points.

    Points are direction times range, as if all rays began at 0; a dropped ray's point is 0 in both clouds.
    To be averaged. Not in the paper; in the authors' code with weight 1.

    Args:
        direction: (r, 3) unit vectors.
        rendered_range_m: (r,).
        true_range_m: (r,) recorded, 0 = no return.
    """
    is_return = true_range_m > 0
    rendered = direction * (rendered_range_m * is_return)[:, None]
    to_recorded, to_rendered = squared_nearest_distances(rendered, direction * true_range_m[:, None])
    return 0.5 * (to_recorded + to_rendered)


@torch.no_grad()
def _nearest(points: Tensor, others: Tensor) -> Tensor:
    """Index (n,) of each point's nearest other point: by k-d tree on the CPU, else by all pairs."""
    if points.device.type == "cpu":
        return torch.from_numpy(cKDTree(others.detach().numpy()).query(points.detach().numpy())[1])
    return nearest_by_all_pairs(points, others)


@torch.no_grad()
def nearest_by_all_pairs(points: Tensor, others: Tensor) -> Tensor:
    """Index (n,) of the nearest of others (m, 3) to each point (n, 3), from all n m distances in chunks."""
    rows = max(1, _CHUNK_PAIRS // len(others))
    # Of differences: cdist's matrix product loses digits for clouds far from 0.
    mode = "donot_use_mm_for_euclid_dist"
    parts = torch.split(points, rows)
    return torch.cat([torch.cdist(part, others, compute_mode=mode).argmin(dim=1) for part in parts])


def scene_flow_loss(
    points: Tensor,
    forward: Tensor,
    backward: Tensor,
    following: Tensor | None,
    preceding: Tensor | None,
) -> Tensor:
    """CD(S_i + flow_j(S_i), S_(i+j)) of each neighbour j = +1, -1 that exists; to be summed.

    Eq. 5 of the paper (L_flow) with the CD of eq. 4, on clouds without ground. (The authors' code sums half
    of the squared distances instead of averaging.)

    Args:
        points: (k, 3) cloud S_i of the frame; scaled units in the `paper` recipe.
        forward: (k, 3) displacement to the following frame, same unit.
        backward: (k, 3) displacement to the preceding frame.
        following: (m, 3) cloud of the following frame, or None.
        preceding: (l, 3) cloud of the preceding frame, or None.

    Returns:
        (0..2,), squared unit of the inputs; empty if the frame or all its neighbours have no points.

    Raises:
        ShapeError: Points and displacements differ in shape.
        DivergedError: A coordinate is not finite.
    """
    if not points.shape == forward.shape == backward.shape:
        raise ShapeError(
            f"scene_flow_loss: expected three times (k, 3), found {tuple(points.shape)}, "
            f"{tuple(forward.shape)}, {tuple(backward.shape)}"
        )
    pairs = ((forward, following), (backward, preceding))
    terms = [
        chamfer_distance(points + displacement, cloud)
        for displacement, cloud in pairs
        if cloud is not None and len(cloud) and len(points)
    ]
    return torch.stack(terms) if terms else points.new_zeros(0)


def flow_magnitude(forward: Tensor, backward: Tensor) -> Tensor:
    """|flow| of each component (2 k, 3) of two flows (k, 3), to be averaged: prefers points that rest.

    Not in the paper; in the authors' code with weight 1.
    """
    return torch.cat([forward, backward]).abs()
