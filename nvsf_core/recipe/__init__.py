"""Recipes: all settings of a run but the seed, as frozen dataclasses that convert to and from JSON."""
