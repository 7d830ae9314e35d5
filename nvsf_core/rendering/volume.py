"""Volume rendering of the paper's field with evenly spaced samples, for LiDAR and camera rays."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from nvsf_core.errors import DataError, DivergedError, ShapeError
from nvsf_core.rendering.scaled_rays import ScaledRays

ATTRIBUTE_WEIGHT = 1e-4
"""Attributes are not computed for samples of less weight."""

Density = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Unit-cube points (m, 3) to density per scaled unit (m,) and geometry features (m, g)."""

Attributes = Callable[[Tensor, Tensor], Tensor]
"""Directions (m, 3) and geometry features (m, g) to attributes (m, c)."""


@dataclass(frozen=True, slots=True)
class VolumeRender:
    """r rendered rays of s samples each."""

    range_scaled: Tensor
    """(r,) D of eq. 3, scaled units; not divided by the sum of the weights."""
    attributes: Tensor
    """(r, c) sum of w_i a_i."""
    passed: Tensor
    """(r,) transmittance behind the last sample."""


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


def weights_from_optical_depth(optical_depth: Tensor) -> tuple[Tensor, Tensor]:
    """Weights of the samples of each ray from their optical depths tau = density * length.

    ``w_i = exp(-sum of tau_j over j < i) * (1 - exp(-tau_i))``, and the transmittance behind all samples,
    ``exp(-sum of all tau_j)``; together they sum to 1. Logarithms are summed instead of a product of numbers
    near 1, and 1 - exp is expm1, so thin samples keep their weight and their gradient.

    Args:
        optical_depth: (rays, samples) floating, at least 0, front to back; infinity = opaque, 0 = no
            sample. NaN gives NaN.

    Returns:
        weights (rays, samples) in [0, 1], transmittance_after (rays,) in [0, 1].

    Raises:
        ShapeError: not two axes.
        DivergedError: a depth is negative.
    """
    if optical_depth.ndim != 2:
        raise ShapeError(
            f"weights_from_optical_depth: expected (rays, samples), found {tuple(optical_depth.shape)}"
        )
    if bool((optical_depth < 0.0).any()):
        raise DivergedError(
            f"weights_from_optical_depth: expected depths of at least 0, found {optical_depth.min().item()}; "
            "densities and lengths of samples are never negative: look at what makes them"
        )
    # The exclusive sum is shifted rather than subtracted, which would cancel.
    depth_before = torch.cumsum(functional.pad(optical_depth, (1, 0)), dim=-1)[:, :-1]
    weights = torch.exp(-depth_before) * -torch.expm1(-optical_depth)
    return weights, torch.exp(-optical_depth.sum(dim=-1))


def render_volume(
    density: Density,
    attributes: Attributes,
    rays: ScaledRays,
    *,
    samples: int,
    bound: float,
    generator: torch.Generator | None = None,
) -> VolumeRender:
    """The paper's eq. 3: D = sum_i T_i alpha_i t_i.

    With alpha_i = 1 - exp(-sigma_i d_i) and T_i = exp(-sum_{j<i} sigma_j d_j).

    Args:
        density: The field's density, for one sensor and time.
        attributes: The field's heads; evaluated only where w_i exceeds `ATTRIBUTE_WEIGHT`.
        rays: r rays in scaled units.
        samples: Number of samples a ray, evenly spaced from near to far.
        bound: The unit cube is [-bound, bound]^3 in scaled units; points outside are clamped to its faces.
        generator: Jitters the samples in training; None = no jitter.
    """
    t, delta = uniform_samples(rays.near, rays.far, samples, generator)
    points = rays.origin[:, None, :] + rays.direction[:, None, :] * t[:, :, None]
    x01 = points.clamp(-bound, bound) / (2.0 * bound) + 0.5
    sigma, geometry = density(x01.reshape(-1, 3))
    weights, passed = weights_from_optical_depth(sigma.reshape(t.shape) * delta)
    composited = _composite(attributes, rays.direction, geometry, weights)
    return VolumeRender((weights * t).sum(dim=1), composited, passed)


def _composite(attributes: Attributes, direction: Tensor, geometry: Tensor, weights: Tensor) -> Tensor:
    """Sum over samples of w a(x, d), (r, c); only samples of enough weight take memory."""
    ray, sample = torch.nonzero(weights.detach() > ATTRIBUTE_WEIGHT, as_tuple=True)
    values = attributes(direction[ray], geometry.reshape(*weights.shape, -1)[ray, sample])
    summed = weights.new_zeros(len(weights), values.shape[1])
    return summed.index_add(0, ray, weights[ray, sample][:, None] * values)


def on_white(render: VolumeRender) -> Tensor:
    """Colours (r, 3) on the authors' white background: the transmitted share is added as white."""
    return render.attributes + render.passed[:, None]
