"""Measure: the errors of each scene, of the field and of the baselines."""

from assets.factory import assets_of_group

measure_assets = assets_of_group("measure")
