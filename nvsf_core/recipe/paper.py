"""Recipes of "Self-Supervised Multimodal NeRF for Autonomous Driving", with one switch per part.

Defaults follow the paper's text. Where the authors' released code differs, it is another value of the same
switch. `docs/paper_fidelity.md` has a row for each.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.bounds import (
    Count,
    CountOrZero,
    Finite,
    GridCount,
    Log2Table,
    NotNegative,
    Positive,
    Resolution,
    Share,
    ShareOrZero,
    Spec,
    Within,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class GridSpec(Spec):
    """A multiresolution hash grid."""

    ORDER = ("base_resolution", "<=", "finest_resolution")

    levels: GridCount
    """Number of resolutions."""
    features: GridCount
    """Features per entry."""
    log2_table: Log2Table
    """Base-2 logarithm of the entries per level."""
    base_resolution: Resolution
    """Grid points per axis of the coarsest level."""
    finest_resolution: Resolution
    """Grid points per axis of the finest level."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeGridSpec(Spec):
    """The dynamic hash grid: for each of the planes xy, xz, yz, one 2-D hash grid per time slice."""

    ORDER = ("base_resolution", "<=", "finest_resolution")

    slices: Count = 8
    """Grids along time, blended linearly."""
    levels: GridCount = 8
    """Number of resolutions of each grid."""
    features: GridCount = 4
    """Numbers per entry: values at the four nodes of the cubic time basis."""
    log2_tables: tuple[Log2Table, Log2Table, Log2Table] = (15, 13, 13)
    """Base-2 logarithm of the entries per level, for xy, xz, yz."""
    base_resolution: Resolution = 512
    """Grid points per axis of the coarsest level."""
    finest_resolution: Resolution = 32768
    """Grid points per axis of the finest level."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanesSpec(Spec):
    """K-planes: six planes per scale, three in space and three with time."""

    scales: tuple[Count, ...] = (1, 2, 4, 8)
    """Factors on the resolution in space; time is not refined."""
    features: Count = 8
    """Features per cell; those of the six planes are multiplied."""
    space_resolution: Count = 32
    """Cells along a spatial axis at scale 1."""
    time_resolution: Count = 8
    """Cells along time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EncoderSpec(Spec):
    """The 4D hybrid encoding of one sensor."""

    static: GridSpec = GridSpec(
        levels=8, features=4, log2_table=19, base_resolution=512, finest_resolution=32768
    )
    """Hash grid in space."""
    dynamic: TimeGridSpec = TimeGridSpec()
    """Hash grids in planes and time."""
    planes: PlanesSpec = PlanesSpec()
    """K-planes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowSpec(Spec):
    """The flow network, shared by both sensors."""

    grid: GridSpec = GridSpec(
        levels=16, features=8, log2_table=18, base_resolution=32, finest_resolution=8192
    )
    """Its own hash grid; each level's features are contracted over the four nodes of the time basis."""
    hidden: Count = 64
    """Width of its two hidden layers."""
    points: Count = 8192
    """Most points per step of each compared cloud, ground removed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HeadsSpec(Spec):
    """Networks that follow the encoding."""

    hidden: Count = 64
    """Width of all hidden layers."""
    geometry_features: Count = 15
    """Features passed from the density network to the heads."""
    lidar_frequencies: Annotated[int, Within(1, 64)] = 12
    """Octaves of the frequency encoding of LiDAR directions."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RefinementSpec(Spec):
    """The U-Net that corrects the hit probabilities of whole panos, trained last."""

    channels: CountOrZero = 32
    """Channels of its first stage; 0 = no U-Net."""
    steps: Count = 1000
    """Optimiser steps; each sees `frames_a_step` panos."""
    rate: Positive = 1e-3
    """Highest step size of the one-cycle schedule."""
    frames_a_step: CountOrZero = 0
    """Panos per step, taken in a fixed order; 0 = all, with accumulated gradients."""
    panos: CountOrZero = 0
    """Training panos to render for it, evenly chosen; 0 = all."""
    column_step: Count = 1
    """Step between the columns of a pano on which it is trained and applied."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperSampling(Spec):
    """How many rays a step samples, and which points on them."""

    ORDER = ("near_m", "<", "far_m")

    rays: Count = 2048
    """Rays per sensor and step, all of one frame."""
    rays_at_once: Count = 256
    """Rays in memory at once; gradients of the parts are added up."""
    samples: Count = 768
    """Points per ray, evenly spaced."""
    near_m: NotNegative = 1.0
    """Range of the first point."""
    far_m: Positive = 80.0
    """Range of a LiDAR ray's last point; a camera ray ends where it leaves the box."""
    heuristic: bool = True
    """In every second epoch, sample rays by the error map instead of uniformly."""
    patches: tuple[Count, Count] | None = (2, 8)
    """LiDAR patches (rows, columns) in every second epoch, for the gradient loss; None = single pixels."""
    camera: bool = True
    """Camera rays besides LiDAR rays; without them no camera network is built."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GradientLossSpec(Spec):
    """Where and how neighbouring ranges are compared."""

    mask: Literal["double", "single"] = "double"
    """Mask by the change of the absolute gradient (this paper), or by the gradient (LiDAR-NeRF)."""
    threshold_m: NotNegative = 0.05
    """Largest value inside the mask; the single-gradient codes use 0.01."""
    norm: Literal["l1", "mse"] = "l1"
    """The paper's equation says L1, its text MSE."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperLosses(Spec):
    """Weights lambda_1 to lambda_6 of the paper's total, then two more terms of the authors' code."""

    flow: Finite = 1.0
    """Chamfer distance of the moved cloud to the neighbours', squared scaled units."""
    depth: Finite = 1.0
    """Sum over rays of the absolute range error, scaled units."""
    intensity: Finite = 0.1
    """Sum over rays of the squared intensity error."""
    raydrop: Finite = 0.01
    """Sum over rays of the squared error of the hit probability."""
    gradient: Finite = 0.01
    """Sum over masked pixels of the gradient error, metres; the authors' code 0.1."""
    colour: Finite = 1.0
    """Sum over rays and channels of the squared colour error."""
    chamfer: Finite = 0.0
    """Chamfer distance of the ray batch, m2; the authors' code 1, not in the paper."""
    flow_magnitude: Finite = 0.0
    """Mean absolute flow; the authors' code 1, not in the paper."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperOptimiser(Spec):
    """Adam's step sizes, by group, and schedule."""

    steps: Count = 30_000
    """Optimiser steps, each on one frame."""
    table_rate: Positive = 1e-2
    """Step size of encodings, density and colour networks."""
    head_rate: Positive = 1e-3
    """Step size of the intensity and hit heads."""
    flow_rate: Positive = 1e-3
    """Step size of the flow network with its hash grid."""
    final_share: Share = 0.1
    """All decay exponentially to this share of their first value."""
    ema_decay: ShareOrZero = 0.95
    """Decay of the weights' moving average, updated once per epoch; 0 = no average."""
    checkpoint_s: NotNegative = 60.0
    """Seconds between two checkpoints."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceQuirks(Spec):
    """What the authors' code does that its paper does not say; each off by default."""

    flow_unit: bool = False
    """Add the flow, learned in scaled units, to unit-cube coordinates: too far by the factor 2 x bound."""
    neighbour_times: bool = False
    """Neighbouring frames' times as (i +- 1)/n, although a frame's own time is i/(n - 1)."""
    bound: Positive = 1.0
    """The code's 2 leaves half of every grid axis empty."""
    minmax_box: bool = False
    """Box around all points instead of all but the outermost 0.1 %."""
    half_precision_truth: bool = False
    """Round true ranges to float16 in scaled units."""
    recorded_elevations: bool = False
    """Cast panos' rays as recorded, although those of sweeps are turned up to where they truly point."""
    identical_tables: bool = False
    """Initialise all grids of one shape with the same numbers (one seed)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperRecipe(Recipe):
    """All settings of the family `paper`: the paper's system, or a part of it."""

    family: ClassVar[str] = "paper"
    """Name of the family whose code trains it."""

    encoders: Literal["same", "separate", "separate_fused"] = "separate"
    """One encoding for both sensors; one each; or one each, fused before the density network."""
    aggregate: bool = True
    """Mix the dynamic features of both neighbouring frames, found by the flow, into a frame's own."""
    encoder: EncoderSpec = EncoderSpec()
    flow: FlowSpec = FlowSpec()
    heads: HeadsSpec = HeadsSpec()
    sampling: PaperSampling = PaperSampling()
    gradient: GradientLossSpec = GradientLossSpec()
    losses: PaperLosses = PaperLosses()
    optimiser: PaperOptimiser = PaperOptimiser()
    refinement: RefinementSpec = RefinementSpec()
    slips: ReferenceQuirks = ReferenceQuirks()
