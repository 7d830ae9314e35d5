"""Prepare: grids, rectified images and what the LiDAR already proves."""

from assets.factory import assets_of_group

prepare_assets = assets_of_group("prepare")
