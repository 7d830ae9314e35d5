"""Losses of scene flow: a frame's moved cloud has to fit the clouds of the neighbouring frames."""

import torch
from torch import Tensor

from nvsf_core.errors import ShapeError
from nvsf_core.losses.chamfer import chamfer_distance


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
