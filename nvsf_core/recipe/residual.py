"""Recipes of the family `residual`: rendering starts from the evidence, and fields learn to correct it."""

from dataclasses import dataclass
from typing import ClassVar

from nvsf_core.recipe.base import Recipe


@dataclass(frozen=True, slots=True, kw_only=True)
class EvidenceSpec:
    """Use of the evidence in rendering."""

    votes: int = 6
    """Number of training scans, nearest in time, from which a ray's hit prior is computed."""
    lidar_candidates: int = 24
    """Most surfels composited along one LiDAR ray."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldSpec:
    """Size of the LiDAR's residual field."""

    levels: int = 8
    """Resolution levels of the hash grid."""
    features: int = 2
    """Features per entry of the hash table."""
    log2_table: int = 17
    """Base-2 logarithm of the most entries per level."""
    coarsest_cell_m: float = 4.0
    """Cell edge of the coarsest level."""
    finest_cell_m: float = 0.06
    """Cell edge of the finest level."""
    hidden: int = 32
    """Width of the network evaluated at each surfel along a ray."""
    decoded: int = 8
    """Features per surfel that are composited along a ray and then decoded once."""
    decoder_hidden: int = 64
    """Width of the network that decodes a ray's composited features."""
    max_shift_m: float = 0.15
    """Largest correction of a surfel's range, in either direction."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSpec:
    """How the depth of images is found, and views are blended from them; the same for all cameras."""

    sources: int = 4
    """Number of training images that a view is blended from, and that an image's depth is found with."""
    planes: int = 48
    """Number of depth planes compared, evenly spaced in inverse depth."""
    near_m: float = 2.5
    """Depth of the nearest plane."""
    far_m: float = 300.0
    """Depth of the farthest plane."""
    plane_px: int = 33_000
    """Planes are compared on images shrunk, by a whole factor, to about this many pixels."""
    depth_channels: tuple[int, int] = (12, 16)
    """Channels of the depth network, at its two lower resolutions."""
    aligned: bool = False
    """Correct camera poses so that LiDAR returns have similar colours in neighbouring images. Depths are
    found with recorded poses."""
    judge_every: int = 9
    """One of so many training images is for validation: they choose what is shown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingSpec:
    """Length of a training, in steps and not in seconds, and its step sizes."""

    steps: int
    """Number of optimiser steps."""
    rays: int
    """Rays per step, sampled from all training frames. For the depth network: pixels per step, of crops of
    the shrunk images."""
    table_rate: float = 1e-2
    """Adam's step size for the hash tables."""
    network_rate: float = 3e-3
    """Adam's step size for the networks."""
    final_share: float = 0.05
    """Both rates decay exponentially to this share of their first value."""
    averaged_share: float = 0.0
    """The mean of the weights after this share of the steps, the last ones, is used; 0 = the last weights."""
    parts: int = 2
    """Parts of a step that CPU threads compute beside each other, each of its own share of the rays, drawn by
    itself; their gradients are added."""
    checkpoint_s: float = 20.0
    """Seconds between two checkpoints."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LossWeights:
    """Weights of the loss terms. Each term has its own unit, and so each weight its inverse."""

    depth: float = 1.0
    """Of the weighted distance between a ray's surfels and its return, metres; for rays that meet moving
    objects, of the return's negative log-likelihood, nats."""
    hit: float = 0.5
    """Of the hit probability's cross-entropy, nats."""
    intensity: float = 5.0
    """Of the squared intensity error."""
    coarse: float = 3.0
    """Of the squared colour error of the mean over all depth planes of an image."""
    plane: float = 0.15
    """Of the absolute colour error of each depth plane, weighted by the plane's probability."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PanoSpec:
    """The paper's pano, rendered from several simulated sweeps and not projected from one scan."""

    phases: int = 2
    """Number of simulated sweeps, each with another offset of its first firing."""
    parts: int = 4
    """Number of rotated copies of each sweep, which fill the angles between two phases."""
    channels: int = 20
    """Channels of the network over cells."""
    layers: int = 3
    """Layers with so many channels."""
    neighbours: int = 6
    """Number of training panos, nearest in time, that are inputs of the network."""
    frames: int = 28
    """Most training frames to learn from; evenly spread."""
    judge_every: int = 5
    """One of so many of these frames is for validation: they choose whether the network is used."""
    training: TrainingSpec | None = None
    """None = no network. `rays` is the number of cells per step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HitsSpec:
    """The raydrop network: hit probabilities on the recording sensor's own grid of lasers and firings."""

    channels: int = 16
    """Channels of the network over cells; with 20, convolutions take three times as long."""
    layers: int = 3
    """Layers with so many channels."""
    frames: int = 28
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
