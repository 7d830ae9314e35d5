"""Where along a ray the field is asked."""

import torch
from torch import Tensor

from nvsf_core.errors import DataError, ShapeError


def uniform_samples(
    near: Tensor, far: Tensor, count: int, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Distances t_i of a ray's samples and the lengths delta_i = t_(i+1) - t_i between them.

    t_i = near + (far - near) i / (count - 1), both ends included (the paper's 768 points a ray). With a
    generator, as in training, each is moved by (u - 1/2) (far - near) / count, u even in [0, 1), and kept
    within [near, far]; the order stays. The last length is (far - near) / count. (The authors' code does
    not keep the moved points within the limits.)

    Args:
        near: (r,) distance of the first sample, any unit of length.
        far: (r,) distance of the last, same unit, not below `near`.
        count: Samples a ray, at least 1; one alone lies at `near`.
        generator: Draws the jitter; None leaves the samples in place.

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
    # An infinite length times the share 0 is NaN: such a ray has no samples.
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
        # Neighbours are 1/(count-1) apart and move by less than 1/count towards each other: the running
        # maximum undoes only what float rounding does to that.
        share = (share + (jitter.to(near.device) - 0.5) / count).clamp(0.0, 1.0).cummax(dim=1).values
    t = torch.minimum(near[:, None] + length * share, far[:, None])
    return t, torch.cat([t[:, 1:] - t[:, :-1], length / count], dim=1)
