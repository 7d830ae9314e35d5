"""What a machine with a GPU can say of this project, by ``python -m benchmarks.gpu``."""
