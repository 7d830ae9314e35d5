"""Recipes that start from evidence and learn a residual."""

from dataclasses import dataclass
from typing import ClassVar

from nvsf_core.recipe.base import Recipe


@dataclass(frozen=True, slots=True, kw_only=True)
class EvidenceSpec:
    """How the LiDAR's own proof is used."""

    votes: int = 6
    """Nearest training scans that vote on whether a laser's firing returns."""
    lidar_candidates: int = 24
    """Most surfaces that a LiDAR ray looks at."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldSpec:
    """The largest residual field of the LiDAR; a scene gets what its evidence fills of it."""

    levels: int = 8
    """Most levels of the hash grid."""
    features: int = 2
    """Features an entry."""
    log2_table: int = 17
    """Most entries a level, as a power of two."""
    coarsest_cell_m: float = 4.0
    """Cell of the coarsest level."""
    finest_cell_m: float = 0.06
    """Smallest cell of the finest level."""
    hidden: int = 32
    """Width of the network at a sample."""
    decoded: int = 8
    """Features that are composited along a ray and decoded once."""
    decoder_hidden: int = 64
    """Width of the network at a ray."""
    max_shift_m: float = 0.15
    """Most that a surface may be moved along a ray."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSpec:
    """The networks that choose depths for recorded images and blend them; the same for all cameras."""

    sources: int = 4
    """Nearest training images that a view is made of."""
    planes: int = 48
    """Depths that are compared, evenly spaced in inverse depth."""
    near_m: float = 2.5
    """Nearest plane."""
    far_m: float = 300.0
    """Farthest plane."""
    plane_px: int = 33_000
    """Planes are compared on images shrunk by a whole number to about so many pixels."""
    depth_channels: tuple[int, int] = (12, 16)
    """Widths of the network over planes, at its two resolutions."""
    blend_channels: tuple[int, int] = (24, 32)
    """Widths of the network that blends, at half resolution and below."""
    refinements: int = 0
    """Depths around each believed one that are compared on images of twice the planes' resolution; odd,
    0 = believed depths stay as they are."""
    refined_channels: int = 24
    """Width of the network that compares them."""
    aligned: bool = False
    """The images' poses are corrected until LiDAR returns look alike in neighbouring images. The networks
    learn with the poses as given: a wanted view's own error stays, and they are to reckon with it."""
    varied: bool = False
    """Every step's image, and its sources with it, in other colours and another light, every second in a
    mirror: so long trainings learn the few images by heart later. It does not pay in short ones."""
    members: int = 1
    """Networks that learn apart from each other and are shown together. Each costs as much again, in training
    and in rendering."""
    judge_every: int = 9
    """Of so many training images one is never learned from but decides whether learning beat `reproject`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingSpec:
    """How much is learned. Steps, never seconds: seconds are measured."""

    steps: int
    """Optimiser steps."""
    rays: int
    """Rays a step, drawn from all training frames; of the camera's networks: pixels of one
    crop of shrunk images a step."""
    table_rate: float = 1e-2
    """Adam's step size for the hash tables."""
    network_rate: float = 3e-3
    """Adam's step size for the networks."""
    final_share: float = 0.05
    """Both rates decay exponentially to this share of themselves."""
    checkpoint_s: float = 20.0
    """Seconds between two checkpoints."""
    threads: int = 2
    """CPU threads, part of the identity: sums in another order give other bits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LossWeights:
    """Weights of the loss terms; each term is in its own unit."""

    depth: float = 1.0
    """Of the weighted distance of a ray's surfaces to the return, metres; of a ray that meets what moves, of
    how unlikely they make it, nats."""
    hit: float = 0.5
    """Of the cross-entropy of the hit probability, nats."""
    intensity: float = 5.0
    """Of the squared intensity error."""
    colour: float = 10.0
    """Of the squared colour error."""
    colour_distance: float = 0.3
    """Of the absolute colour error, which keeps edges sharper than its square."""
    coarse: float = 3.0
    """Of the squared colour error of all depth planes' mean."""
    plane: float = 0.15
    """Of the absolute colour error that a depth plane is believed to have."""
    structure: float = 0.0
    """Of 1 - SSIM in small windows: what is blurred costs as much in dim leaves as at bright edges."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PanoSpec:
    """The papers' range image as a view of its own, and not the projection of one simulated scan."""

    phases: int = 2
    """Turns that are fired, each starting at another phase of the firings."""
    parts: int = 4
    """Every turn is looked at so many times, turned by parts of what lies between two phases."""
    channels: int = 20
    """Width of the network over cells."""
    layers: int = 3
    """Layers of that width."""
    neighbours: int = 6
    """Nearest training panos that the network is told of."""
    frames: int = 28
    """Most training frames that the network learns from; evenly spread."""
    judge_every: int = 5
    """Of so many of these frames one is never learned from but decides whether the network is used."""
    training: TrainingSpec | None = None
    """None = no network; `rays` are a step's cells."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HitsSpec:
    """The network over the recording sensor's own grid of lasers and firings: what returns."""

    channels: int = 16
    """Width of the network over cells; of 20 the convolutions take three times as long."""
    layers: int = 3
    """Layers of that width."""
    frames: int = 28
    """Most training frames that the network learns from; evenly spread."""
    training: TrainingSpec
    """`rays` are a step's cells."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualRecipe(Recipe):
    """Evidence first; what is left is learned."""

    family: ClassVar[str] = "residual"
    """Which code trains it."""

    evidence: EvidenceSpec = EvidenceSpec()
    lidar_field: FieldSpec = FieldSpec()
    camera: CameraSpec = CameraSpec()
    lidar_training: TrainingSpec = TrainingSpec(steps=1250, rays=4096)
    depth_training: TrainingSpec = TrainingSpec(steps=120, rays=8064, network_rate=5e-3)
    camera_training: TrainingSpec = TrainingSpec(steps=160, rays=3200, network_rate=2e-3)
    losses: LossWeights = LossWeights()
    pano: PanoSpec | None = None
    """None = the pano is the projection of the simulated scan."""
    hits: HitsSpec | None = None
    """None = the ray head alone says what returns."""
