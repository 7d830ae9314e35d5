"""Recipes of the family `residual`: rendering starts from the evidence, and fields learn to correct it."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from nvsf_core.errors import RecipeError
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.bounds import (
    Count,
    CountOrZero,
    Finite,
    GridCount,
    Log2Table,
    NotNegative,
    Positive,
    Several,
    Share,
    ShareOrZero,
    Spec,
    Within,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class EvidenceSpec(Spec):
    """Use of the evidence in rendering."""

    votes: Count = 6
    """Number of training scans, nearest in time, from which a ray's hit prior is computed."""
    lidar_candidates: Count = 24
    """Most surfels composited along one LiDAR ray."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldSpec(Spec):
    """Size of the LiDAR's residual field."""

    ORDER = ("finest_cell_m", "<=", "coarsest_cell_m")

    levels: GridCount = 8
    """Resolution levels of the hash grid."""
    features: GridCount = 2
    """Features per entry of the hash table."""
    log2_table: Log2Table = 17
    """Base-2 logarithm of the most entries per level."""
    coarsest_cell_m: Positive = 4.0
    """Cell edge of the coarsest level."""
    finest_cell_m: Positive = 0.06
    """Cell edge of the finest level."""
    hidden: Count = 32
    """Width of the network evaluated at each surfel along a ray."""
    decoded: Count = 8
    """Features per surfel that are composited along a ray and then decoded once."""
    decoder_hidden: Count = 64
    """Width of the network that decodes a ray's composited features."""
    max_shift_m: NotNegative = 0.15
    """Largest correction of a surfel's range, in either direction."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSpec(Spec):
    """How the depth of images is found, and views are blended from them; the same for all cameras."""

    ORDER = ("near_m", "<", "far_m")

    sources: Count = 4
    """Number of training images that a view is blended from, and that an image's depth is found with."""
    planes: Several = 48
    """Number of depth planes compared, evenly spaced in inverse depth."""
    near_m: Positive = 2.5
    """Depth of the nearest plane."""
    far_m: Positive = 300.0
    """Depth of the farthest plane."""
    plane_px: Annotated[int, Within(64)] = 33_000
    """Planes are compared on images shrunk, by a whole factor, to about this many pixels."""
    depth_channels: tuple[Count, Count] = (12, 16)
    """Channels of the depth network, at its two lower resolutions."""
    aligned: bool = False
    """Correct camera poses so that LiDAR returns have similar colours in neighbouring images. Depths are
    found with recorded poses."""
    judge_every: Several = 9
    """One of so many training images is for validation: they choose what is shown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingSpec(Spec):
    """Length of a training, in steps and not in seconds, and its step sizes."""

    steps: Count
    """Number of optimiser steps."""
    rays: Count
    """Rays per step, sampled from all training frames. For the depth network: pixels per step, of crops of
    the shrunk images."""
    table_rate: Positive = 1e-2
    """Adam's step size for the hash tables."""
    network_rate: Positive = 3e-3
    """Adam's step size for the networks."""
    final_share: Share = 0.05
    """Both rates decay exponentially to this share of their first value."""
    averaged_share: ShareOrZero = 0.0
    """The mean of the weights after this share of the steps, the last ones, is used; 0 = the last weights."""
    parts: Count = 2
    """Parts of a step that CPU threads compute beside each other, each of its own share of the rays, drawn by
    itself; their gradients are added."""
    checkpoint_s: NotNegative = 20.0
    """Seconds between two checkpoints."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LossWeights(Spec):
    """Weights of the loss terms. Each term has its own unit, and so each weight its inverse.

    A weight below 0 rewards errors: so the tests break a model on purpose.
    """

    depth: Finite = 1.0
    """Of the weighted distance between a ray's surfels and its return, metres; for rays that meet moving
    objects, of the return's negative log-likelihood, nats."""
    hit: Finite = 0.5
    """Of the hit probability's cross-entropy, nats."""
    intensity: Finite = 5.0
    """Of the squared intensity error."""
    coarse: Finite = 3.0
    """Of the squared colour error of the mean over all depth planes of an image."""
    plane: Finite = 0.15
    """Of the absolute colour error of each depth plane, weighted by the plane's probability."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PanoSpec(Spec):
    """The paper's pano, rendered from several simulated sweeps and not projected from one scan."""

    phases: Count = 2
    """Number of simulated sweeps, each with another offset of its first firing."""
    parts: Count = 4
    """Number of rotated copies of each sweep, which fill the angles between two phases."""
    channels: Count = 20
    """Channels of the network over cells."""
    layers: CountOrZero = 3
    """Layers with so many channels."""
    neighbours: Count = 6
    """Number of training panos, nearest in time, that are inputs of the network."""
    frames: Several = 28
    """Most training frames to learn from; evenly spread."""
    judge_every: Several = 5
    """One of so many of these frames is for validation: they choose whether the network is used."""
    training: TrainingSpec | None = None
    """None = no network. `rays` is the number of cells per step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HitsSpec(Spec):
    """The raydrop network: hit probabilities on the recording sensor's own grid of lasers and firings."""

    channels: Count = 16
    """Channels of the network over cells; with 20, convolutions take three times as long."""
    layers: CountOrZero = 3
    """Layers with so many channels."""
    frames: Count = 28
    """Most training frames to learn from; evenly spread."""
    training: TrainingSpec
    """`rays` is the number of cells per step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualRecipe(Recipe):
    """All settings of the family `residual`."""

    family: ClassVar[str] = "residual"
    """Name of the family whose code trains it."""

    evidence: EvidenceSpec = EvidenceSpec()
    lidar_field: FieldSpec = FieldSpec()
    camera: CameraSpec = CameraSpec()
    lidar_training: TrainingSpec = TrainingSpec(
        steps=850, rays=4096, table_rate=2e-2, final_share=1.0, averaged_share=0.4
    )
    depth_training: TrainingSpec = TrainingSpec(steps=20, rays=8064, network_rate=5e-3)
    losses: LossWeights = LossWeights()
    pano: PanoSpec | None = None
    """None = the pano is projected from the simulated scan."""
    hits: HitsSpec | None = None
    """None = hit probabilities are the ray head's alone."""

    def __post_init__(self) -> None:
        """Check all values; each part of a LiDAR step, too, needs a ray.

        Raises:
            RecipeError: One is wrong.
        """
        Recipe.__post_init__(self)
        if self.lidar_training.rays < self.lidar_training.parts:
            raise RecipeError(
                f"{type(self).__name__}.lidar_training: expected at least as many rays as parts, found "
                f"{self.lidar_training.rays} and {self.lidar_training.parts}"
            )
