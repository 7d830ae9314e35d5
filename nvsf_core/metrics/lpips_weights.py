"""The weights file of LPIPS, made from two public files: the heads and the backbone they were trained on."""

from pathlib import Path

import torch
from torch import Tensor

from nvsf_core.errors import StoreError
from nvsf_core.metrics.lpips import require_version_0_1
from nvsf_core.stores.checkpoints import save_tensors

BACKBONE_URL = "https://download.pytorch.org/models/squeezenet1_1-b8a52dc0.pth"
"""SqueezeNet 1.1 as torchvision publishes it (weights IMAGENET1K_V1)."""
HEADS_PLACE = "weights/v0.1/squeeze.pth"
"""The heads' file inside the Python package `lpips` (richzhang/PerceptualSimilarity)."""
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""By which the authors normalise images in -1..1, a channel each."""


def make_lpips_weights(heads: Path, backbone: Path, made: Path) -> None:
    """Write `made`, a safetensors file that `NVSF_LPIPS_WEIGHTS` can name.

    Of `HEADS_PLACE` of the package `lpips`, and what `BACKBONE_URL` names.

    Raises:
        StoreError: A file holds other numbers than version 0.1's; nothing is written.
    """
    tensors = {
        name: value for name, value in _read(backbone).items() if name.startswith("features.")
    }  # the classifier behind them is not used
    for name, value in _read(heads).items():
        number = name.partition(".")[0].removeprefix("lin")
        tensors[f"lin.{number}"] = value.flatten()
    tensors["shift"] = torch.tensor(_SHIFT).view(1, 3, 1, 1)
    tensors["scale"] = torch.tensor(_SCALE).view(1, 3, 1, 1)
    require_version_0_1(tensors, f"{heads} and {backbone}")
    save_tensors(made, {name: value.float().contiguous() for name, value in tensors.items()})


def _read(path: Path) -> dict[str, Tensor]:
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises a dozen kinds for a damaged file
        raise StoreError(f"expected tensors saved by torch at {path}, found {error!s:.100}") from error
    if not isinstance(found, dict) or not all(isinstance(value, Tensor) for value in found.values()):
        raise StoreError(f"expected named tensors at {path}, found {type(found).__name__}")
    return dict(found)
