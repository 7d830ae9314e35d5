"""Rotating LiDARs: their lasers, their rays, their range images."""
