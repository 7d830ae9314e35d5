"""Ingest: the recorded drive, validated and turned into rays."""

from assets.factory import assets_of_group

ingest_assets = assets_of_group("ingest")
