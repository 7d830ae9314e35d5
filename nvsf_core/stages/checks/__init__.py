"""Conditions on what the stages made."""
