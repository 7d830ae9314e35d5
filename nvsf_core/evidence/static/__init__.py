"""What never moves: voxels that hold returns, as surfaces; the ground; space that no ray observed."""
