"""Synthesis: novel views of the held-out frames, and what the catalogue asks for."""

from assets.factory import assets_of_group

synthesis_assets = assets_of_group("synthesis")
