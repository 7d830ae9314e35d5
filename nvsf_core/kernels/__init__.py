"""The inner loops: hash-grid encode and its adjoint, voxel march, z-buffer; torch oracle and numba."""
