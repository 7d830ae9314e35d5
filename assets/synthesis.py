"""Synthesis: novel views and versioned data sets."""

from assets.factory import assets_of_group

synthesis_assets = assets_of_group("synthesis")
