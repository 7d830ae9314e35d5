"""Surfels that images prove."""
