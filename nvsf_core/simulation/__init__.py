"""Simulation of LiDAR sweeps: which rays are fired, which return, and the scan that they give."""
