"""Raw arrays in, raw arrays out: the hash-grid encode and its adjoint; torch oracle and numba (CPU)."""

from nvsf_core.kernels.hash_grid import Backend, hash_grid_encode
from nvsf_core.kernels.layout import GridLayout

__all__ = ["Backend", "GridLayout", "hash_grid_encode"]
