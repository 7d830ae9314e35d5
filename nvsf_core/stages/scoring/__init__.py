"""Measure rendered views against recorded data, as rows of metrics."""
