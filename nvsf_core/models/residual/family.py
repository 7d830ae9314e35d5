"""The family `residual` (recipes `lean`, `quick`, `smoke`); implements `Family`."""

from nvsf_core.models.residual.capacity import needs
from nvsf_core.models.residual.render import load
from nvsf_core.models.residual.train import train

__all__ = ["load", "needs", "train"]
