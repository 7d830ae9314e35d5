"""Encodings of positions (hash grids and planes, in space and time) and of directions, as features."""

from nvsf_core.encodings.directions import (
    SPHERICAL_HARMONICS_OUTPUTS,
    frequency_encode,
    frequency_outputs,
    spherical_harmonics,
)
from nvsf_core.encodings.hash_time import HashTime, cubic_basis
from nvsf_core.encodings.hybrid import HybridEncoding
from nvsf_core.encodings.planes import Planes4D
from nvsf_core.kernels.encodings.hash_grid import HashGrid, start_alike

__all__ = [
    "SPHERICAL_HARMONICS_OUTPUTS",
    "HashGrid",
    "HashTime",
    "HybridEncoding",
    "Planes4D",
    "cubic_basis",
    "frequency_encode",
    "frequency_outputs",
    "spherical_harmonics",
    "start_alike",
]
