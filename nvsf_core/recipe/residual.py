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
    camera_candidates: int = 12
    """Most surfaces that a camera ray looks at."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldSpec:
    """Size of a residual field: one for the LiDAR, one for the cameras."""

    levels: int = 8
    """Levels of the hash grid."""
    features: int = 2
    """Features an entry."""
    log2_table: int = 17
    """Entries a level, as a power of two."""
    coarsest_cell_m: float = 4.0
    """Cell of the coarsest level."""
    finest_cell_m: float = 0.06
    """Cell of the finest level."""
    hidden: int = 32
    """Width of the network at a sample."""
    decoded: int = 8
    """Features that are composited along a ray and decoded once."""
    decoder_hidden: int = 64
    """Width of the network at a ray."""
    max_shift_m: float = 0.15
    """Most that a surface may be moved along a ray."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BackgroundSpec:
    """Camera samples where no LiDAR return ever was: above its reach and beyond it."""

    samples: int = 12
    """Samples a ray, evenly spaced in log distance."""
    near_m: float = 3.0
    """First sample."""
    far_m: float = 300.0
    """Last sample; what lies beyond is sky."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingSpec:
    """How much is learned. Steps, never seconds: seconds are measured."""

    steps: int
    """Optimiser steps."""
    rays: int
    """Rays a step, drawn from all training frames."""
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
    """Of the weighted distance of a ray's surfaces to the return, metres."""
    hit: float = 0.5
    """Of the cross-entropy of the hit probability, nats."""
    intensity: float = 5.0
    """Of the squared intensity error."""
    colour: float = 1.0
    """Of the squared colour error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualRecipe(Recipe):
    """Evidence first; what is left is learned."""

    family: ClassVar[str] = "residual"
    """Which code trains it."""

    evidence: EvidenceSpec = EvidenceSpec()
    lidar_field: FieldSpec = FieldSpec()
    camera_field: FieldSpec = FieldSpec(levels=10, coarsest_cell_m=16.0, finest_cell_m=0.05, decoded=12)
    background: BackgroundSpec = BackgroundSpec()
    lidar_training: TrainingSpec = TrainingSpec(steps=1250, rays=4096)
    camera_training: TrainingSpec = TrainingSpec(steps=900, rays=2048)
    losses: LossWeights = LossWeights()
