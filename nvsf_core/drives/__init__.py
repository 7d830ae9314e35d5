"""Recorded drives: the catalogue of them, and one folder a format."""
