"""Choices made on validation data: training scans and images that were left out."""
