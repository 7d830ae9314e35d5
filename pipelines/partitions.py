"""One partition a scene of the catalogue, heavy scenes first as the catalogue lists them."""

from assets.factory import scene_partitions

__all__ = ["scene_partitions"]
