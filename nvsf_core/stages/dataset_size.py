"""How much a data set will take on the disk, estimated from the shapes of the rendered views alone."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nvsf_core.stages.runner.stage import Task
from nvsf_core.stores.arrays import array_layouts

BYTES_A_RETURN = {"bin": 16, "ply": 16, "pcd": 16}
"""Of each format: four float32."""
_OTHER_FORMAT_BYTES = 40
"""Of a format that is not listed: a dozen fields, compressed or not."""
_SUPPORT_BYTES = 1
_SAMPLED_MORE = 1.1
"""Sampled scans have up to a tenth more returns than those that the view stores."""
_DEFAULT_EXPORTS = ("bin", "ply")


def dataset_bytes(task: Task) -> int:
    """Estimated bytes of all data sets of a run; views that were not rendered take none."""
    rendered = task.store.path(f"novel_views/{task.config.recipe.name}/{task.config.seed}")
    exports = {"test": _DEFAULT_EXPORTS} | {view.name: view.exports for view in task.scene.views}
    return sum(_view_bytes(rendered / name / "model.zarr", kinds) for name, kinds in exports.items())


def _view_bytes(path: Path, exports: tuple[str, ...]) -> int:
    if not path.is_dir():
        return 0
    arrays = array_layouts(path)
    a_return = sum(BYTES_A_RETURN.get(kind, _OTHER_FORMAT_BYTES) for kind in exports) + _SUPPORT_BYTES
    returns = len(arrays["points_m"]) if "points_m" in arrays else 0
    return int(_SAMPLED_MORE * returns * a_return) + _image_bytes(arrays)


def _image_bytes(arrays: Mapping[str, np.ndarray]) -> int:
    """Of all images, depths and instances as they are in memory: a PNG takes less."""
    kinds = ("_rgb", "_range_m", "_instance")
    own = [one for name, one in arrays.items() if name.startswith("image_") and name.endswith(kinds)]
    return sum(math.prod(one.shape) * one.itemsize for one in own)
