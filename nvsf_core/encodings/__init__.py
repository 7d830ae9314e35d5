"""Positions and directions as features: hash grid, spherical harmonics, frequencies."""

from nvsf_core.encodings.frequency import frequency_encode, frequency_outputs
from nvsf_core.encodings.hash_grid import HashGrid
from nvsf_core.encodings.spherical_harmonics import SPHERICAL_HARMONICS_OUTPUTS, spherical_harmonics

__all__ = [
    "SPHERICAL_HARMONICS_OUTPUTS",
    "HashGrid",
    "frequency_encode",
    "frequency_outputs",
    "spherical_harmonics",
]
