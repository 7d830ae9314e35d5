"""The family `paper` (recipes `paper`, `paper_cpu`, ...); implements `Family`."""

from nvsf_core.models.paper.scene import load
from nvsf_core.models.paper.training.train import train

__all__ = ["load", "train"]
