"""Recipes that start from evidence and learn a residual."""

from dataclasses import dataclass
from typing import ClassVar

from nvsf_core.recipe.base import Recipe


@dataclass(frozen=True, slots=True, kw_only=True)
class EvidenceSpec:
    """How the evidence is used in rendering."""

    votes: int = 6
    """Training scans, nearest in time, whose share of returns is the prior of a ray's hit probability."""
    lidar_candidates: int = 24
    """Most surfaces along one LiDAR ray that are composited."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldSpec:
    """The largest residual field of the LiDAR; a scene whose evidence is smaller gets a smaller one."""

    levels: int = 8
    """Most levels of the hash grid."""
    features: int = 2
    """Features per table entry."""
    log2_table: int = 17
    """Most entries per level, as a power of two."""
    coarsest_cell_m: float = 4.0
    """Cell of the coarsest level."""
    finest_cell_m: float = 0.06
    """Smallest cell of the finest level."""
    hidden: int = 32
    """Width of the network that is evaluated at each surface along a ray."""
    decoded: int = 8
    """Features that are composited along a ray, then decoded once per ray."""
    decoder_hidden: int = 64
    """Width of the network that decodes a ray."""
    max_shift_m: float = 0.15
    """Largest shift of a surface along the ray, either way."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSpec:
    """The networks that choose depths for recorded images and blend them; the same for all cameras."""

    sources: int = 4
    """Training images, nearest to the view, that are warped and blended into it."""
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
    """How many depths around the estimated one are compared at twice the planes' resolution; odd, 0 = the
    estimate is used as it is."""
    refined_channels: int = 24
    """Width of the network that compares them."""
    aligned: bool = False
    """Whether camera poses are corrected so that LiDAR returns look alike in neighbouring images. Networks
    are trained with the uncorrected poses, because the pose of a requested view has such an error, too."""
    varied: bool = False
    """Whether each step's images get random colours and brightness, and half of them are mirrored: with few
    images this delays overfitting in long trainings. It gains nothing in short ones."""
    members: int = 1
    """Networks in the ensemble, trained independently and averaged. Each multiplies the seconds of training
    and of rendering."""
    judge_every: int = 9
    """One of so many training images is kept for validation: it decides whether learning beat `reproject`."""


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
    """Of the weighted distance of a ray's surfaces to its return, metres; for rays that meet moving objects,
    of the return's negative log-likelihood, nats."""
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
    """Of the absolute colour error of each depth plane, weighted by the plane's probability."""
    structure: float = 0.0
    """Of 1 - SSIM in small windows: what is blurred costs as much in dim leaves as at bright edges."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PanoSpec:
    """The papers' range image as a view of its own, and not the projection of one simulated scan."""

    phases: int = 2
    """Sweeps that are simulated, each with another offset of its first firing."""
    parts: int = 4
    """How many rotated copies of each sweep are used, to fill the angles between two phases."""
    channels: int = 20
    """Width of the network over cells."""
    layers: int = 3
    """Layers of that width."""
    neighbours: int = 6
    """Training panos, nearest in time, that are inputs of the network."""
    frames: int = 28
    """Most training frames that the network learns from; evenly spread."""
    judge_every: int = 5
    """One of so many of these frames is kept for validation: it decides whether the network is used."""
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
    """Start from the evidence and learn what it gets wrong."""

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
