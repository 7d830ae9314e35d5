"""Positions and directions as features: hash grid, spherical harmonics."""
