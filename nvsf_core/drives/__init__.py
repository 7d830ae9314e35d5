"""Recorded drives: the scene catalogue, and one folder for each format of recordings."""
