"""Numerically hard cases, one file for each theme; see docs/numerical_stability.md."""
