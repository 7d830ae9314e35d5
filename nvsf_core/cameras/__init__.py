"""Undistorting camera images and their validity masks."""
