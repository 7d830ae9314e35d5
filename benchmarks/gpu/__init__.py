"""Measurements on a machine with a GPU, by ``python -m benchmarks.gpu``."""
