"""Distances along rays at which the paper's field is evaluated."""

import torch
from torch import Tensor

from nvsf_core.errors import DataError, ShapeError


def uniform_samples(
    near: Tensor, far: Tensor, count: int, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Distances t_i of a ray's samples and the lengths delta_i = t_(i+1) - t_i between them.

    t_i = near + (far - near) i / (count - 1), both ends included (768 a ray in the paper). With a generator,
    as in training, each is moved by (u - 1/2) (far - near) / count, u uniform in [0, 1), and clamped to
    [near, far]; their order is kept. The last length is (far - near) / count. (The authors' code does not
    clamp.)

    Args:
        near: (r,) distance of the first sample, in any unit.
        far: (r,) distance of the last, same unit, not below `near`.
        count: Samples a ray, at least 1; one alone lies at `near`.
        generator: For the jitter; None = no jitter.

    Returns:
        t (r, count) ascending, in [near, far]; delta (r, count), at least 0.

    Raises:
        ShapeError: `near` and `far` are not two vectors of one length, or `count` is below 1.
        DataError: A ray ends before it begins, or a limit is not finite.
    """
    if near.ndim != 1 or near.shape != far.shape or count < 1:
        raise ShapeError(
            f"uniform_samples: expected near (r,), far (r,), count >= 1, found {tuple(near.shape)}, "
            f"{tuple(far.shape)}, {count}"
        )
    # An infinite length times a share of 0 would be NaN.
    sound = (far >= near) & torch.isfinite(far - near)
    if not bool(sound.all()):
        bad = int((~sound).nonzero()[0])
        raise DataError(
            f"uniform_samples: expected finite near <= far, found {near[bad].item()} and {far[bad].item()} "
            f"in ray {bad}; leave out the rays that miss the box"
        )
    length = (far - near)[:, None]
    share = torch.linspace(0.0, 1.0, count, device=near.device, dtype=near.dtype).expand(len(near), count)
    if generator is not None:
        jitter = torch.rand(len(near), count, generator=generator, device=generator.device, dtype=near.dtype)
        # Neighbours are 1/(count-1) apart and move by less than 1/count towards each other, so only float
        # rounding can change their order; the running maximum restores it.
        share = (share + (jitter.to(near.device) - 0.5) / count).clamp(0.0, 1.0).cummax(dim=1).values
    t = torch.minimum(near[:, None] + length * share, far[:, None])
    return t, torch.cat([t[:, 1:] - t[:, :-1], length / count], dim=1)
