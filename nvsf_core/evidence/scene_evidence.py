"""Everything that a scene's training sweeps prove, joined; to and from named arrays for the store."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.evidence.surfels import Surfels
from nvsf_core.evidence.voxels import VoxelIndex


@dataclass(frozen=True, slots=True)
class SceneEvidence:
    """One scene's evidence, scene-local metres."""

    surfels: Surfels
    prior: DropPrior
    lasers: np.ndarray
    """(l,) int16: lasers that ever returned, from the top."""
    firings: np.ndarray
    """(n,) int32: firings a turn of each training scan."""
    own_range_m: np.ndarray
    """(lasers, cells) float32: range of the own vehicle by laser and azimuth cell, 0 where it is not."""
    own_intensity: np.ndarray
    """(lasers, cells) float32."""

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Named arrays that `from_arrays` reads back."""
        s, index = self.surfels, self.surfels.index
        return {
            "grid_origin_m": index.origin_m, "voxel_m": np.array([index.voxel_m]), "bricks": index.bricks,
            "cells": index.cells, "mean_m": s.mean_m, "normal": s.normal, "thickness_m": s.thickness_m,
            "intensity": s.intensity, "hits": s.hits, "passes": s.passes, "prior_time_s": self.prior.time_s,
            "prior_fraction": self.prior.fraction, "prior_is_hit": self.prior.is_hit, "lasers": self.lasers,
            "firings": self.firings, "own_range_m": self.own_range_m, "own_intensity": self.own_intensity,
        }  # fmt: skip

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> "SceneEvidence":
        """Read back what `to_arrays` gave."""
        a = arrays
        index = VoxelIndex(a["grid_origin_m"], float(a["voxel_m"][0]), a["bricks"], a["cells"])
        surfels = Surfels(
            index=index, mean_m=a["mean_m"], normal=a["normal"], thickness_m=a["thickness_m"],
            intensity=a["intensity"], hits=a["hits"], passes=a["passes"],
        )  # fmt: skip
        prior = DropPrior(a["prior_time_s"], a["prior_fraction"], a["prior_is_hit"])
        return SceneEvidence(surfels, prior, a["lasers"], a["firings"], a["own_range_m"], a["own_intensity"])
