"""The static part of a scene: surfels, the ground, and unobserved voxels."""
