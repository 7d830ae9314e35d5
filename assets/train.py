"""Train: the scene's field."""

from assets.factory import assets_of_group

train_assets = assets_of_group("train")
