"""LPIPS (Zhang et al. 2018), version 0.1, with the SqueezeNet 1.1 backbone.

Implemented here because every package with it needs torchvision, whose wheels do not load beside CPU torch.
The weights are not part of this repository: `lpips_file` says where they are searched.
"""

import hashlib
from collections.abc import Mapping

import numpy as np
import torch
import torch.nn.functional as functional
from torch import Tensor

from nvsf_core.errors import StoreError
from nvsf_core.metrics.elementwise import same_shape
from nvsf_core.metrics.lpips_file import NO_WEIGHTS, WEIGHTS_NAME, WEIGHTS_VARIABLE, find_weights
from nvsf_core.metrics.measure import Measure, absent, fault, undefined
from nvsf_core.stores.checkpoints import load_tensors

_DIGEST = "c01c153ec40466912849953b531ee86185ddbcbd61029b61715e1eeb07d326f2"
"""`_digest` of version 0.1's weights: other weights give distances that compare with nobody's."""
MIN_SIDE = 32
"""Least side of an image, pixels: the backbone's pools reduce smaller ones to nothing."""

LPIPS_ALEX = absent("LPIPS-Alex: no weights at hand")
"""The measure of the papers' variant, with AlexNet. Its values do not compare with SqueezeNet's."""

_POOLS_BEFORE = (3, 6, 9)
"""Fire modules of SqueezeNet 1.1 that follow a max pool (3x3, stride 2, size rounded up)."""
_FIRES = (3, 4, 6, 7, 9, 10, 11, 12)
_TAPS = (4, 7, 9, 10, 11, 12)
"""Fire modules whose output is compared, besides the first convolution's."""


class Lpips:
    """The network with its weights, on the CPU in float32 (bfloat16 changes distances by up to 1.4e-3)."""

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        # Channels last: the convolutions are twice as fast.
        self._weights = {
            name: value.contiguous(memory_format=torch.channels_last) if value.ndim == 4 else value
            for name, value in weights.items()
        }

    @torch.no_grad()
    def __call__(self, predicted: Tensor, truth: Tensor) -> Tensor:
        """Perceptual distances (B,) of image pairs (B, 3, H, W) in 0..1."""
        total = torch.zeros(predicted.shape[0])
        pairs = zip(self._features(predicted), self._features(truth), strict=True)
        for index, (p, t) in enumerate(pairs):
            difference = (_unit(p) - _unit(t)).square()
            head = self._weights[f"lin.{index}"].view(1, -1, 1, 1)
            total += (difference * head).sum(dim=1).mean(dim=(1, 2))
        return total

    def _features(self, image: Tensor) -> list[Tensor]:
        w = self._weights
        image = image.contiguous(memory_format=torch.channels_last)
        x = (2.0 * image.float() - 1.0 - w["shift"]) / w["scale"]
        x = functional.relu(functional.conv2d(x, w["features.0.weight"], w["features.0.bias"], stride=2))
        taps = [x]
        for layer in _FIRES:
            if layer in _POOLS_BEFORE:
                x = functional.max_pool2d(x, 3, 2, ceil_mode=True)
            x = self._fire(x, f"features.{layer}")
            if layer in _TAPS:
                taps.append(x)
        return taps

    def _fire(self, x: Tensor, name: str) -> Tensor:
        """A Fire module: squeeze to few channels, then expand by 1x1 and 3x3 convolutions, concatenated."""
        squeezed = self._conv(x, f"{name}.squeeze", 0)
        narrow = self._conv(squeezed, f"{name}.expand1x1", 0)
        return torch.cat([narrow, self._conv(squeezed, f"{name}.expand3x3", 1)], dim=1)

    def _conv(self, x: Tensor, name: str, padding: int) -> Tensor:
        weight, bias = self._weights[f"{name}.weight"], self._weights[f"{name}.bias"]
        return functional.relu(functional.conv2d(x, weight, bias, padding=padding))


def _unit(x: Tensor) -> Tensor:
    return x / (x.square().sum(dim=1, keepdim=True).sqrt() + 1e-10)


def load_lpips() -> Lpips | None:
    """The network, or None where `find_weights` finds no weights.

    Raises:
        StoreError: The file is damaged, or holds other weights.
    """
    path = find_weights()
    if path is None:
        return None
    try:
        tensors, _ = load_tensors(path)
    except StoreError:
        tensors = {}
    require_version_0_1(tensors, str(path))
    return Lpips(tensors)


def require_version_0_1(tensors: Mapping[str, Tensor], origin: str) -> None:
    """Refuse weights that are not those of version 0.1, to the last bit.

    Raises:
        StoreError: They are not; it names their `origin`.
    """
    found = _digest(tensors) if tensors else "no readable tensors"
    if found != _DIGEST:
        raise StoreError(
            f"LPIPS weights {origin}: expected the numbers of {WEIGHTS_NAME} (SHA-256 {_DIGEST[:16]}...), "
            f"found {found:.40}; make the file with `nvsf weights`, or remove it and unset "
            f"{WEIGHTS_VARIABLE}: LPIPS is then not run"
        )


def _digest(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 over names and float32 values, in the order of names: independent of the file's format."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].float().contiguous().numpy().tobytes())
    return digest.hexdigest()


def lpips_measure(lpips: Lpips | None, predicted: np.ndarray, truth: np.ndarray) -> Measure:
    """LPIPS of one pair of images (H, W) or (H, W, 3); a single channel is repeated three times.

    Values should be in 0..1. The LiDAR4D protocol passes metres, far outside what the network was trained
    on: such values compare with the papers' only.
    """
    if lpips is None:
        return absent(f"{NO_WEIGHTS}: make them with `nvsf weights`, or set {WEIGHTS_VARIABLE}")
    same_shape(predicted, truth)
    bad = fault(predicted, truth)
    if bad is not None:
        return bad
    if min(truth.shape[:2]) < MIN_SIDE:
        return undefined(f"image {truth.shape[:2]} is smaller than {MIN_SIDE} pixels a side")
    value = float(lpips(_as_batch(predicted), _as_batch(truth))[0])
    return Measure(value, truth.shape[0] * truth.shape[1])


def _as_batch(image: np.ndarray) -> Tensor:
    tensor = torch.from_numpy(np.ascontiguousarray(image, dtype=np.float32))
    if tensor.ndim == 2:
        tensor = tensor[..., None].expand(-1, -1, 3)
    return tensor.permute(2, 0, 1)[None]
