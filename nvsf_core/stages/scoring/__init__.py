"""Rendered views against what was recorded, as rows of metrics."""
