"""Dagster assets made from the stages, one module per asset group; no maths."""
