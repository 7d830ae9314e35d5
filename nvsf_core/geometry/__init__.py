"""Rigid motions, cameras, boxes, and a scene's bounds."""
