"""Kernels of hash grids and feature planes, with gradients, in torch, numba and Triton."""
