"""Hash grids and feature planes: encode and adjoint, one interface over torch, numba and Triton."""
