"""Recorded drives of one format."""
