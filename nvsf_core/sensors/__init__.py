"""Rotating LiDARs: lasers, rays, range images."""
