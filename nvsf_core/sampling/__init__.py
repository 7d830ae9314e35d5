"""Sampling of pixels, and of distances along rays."""
