"""Dagster assets, one module a group; no maths."""
