"""Checks of the stages' outputs."""
