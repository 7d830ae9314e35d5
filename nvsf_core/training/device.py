"""The one place that says where networks learn; everything else goes where its tensors are."""

import torch


def training_device() -> torch.device:
    """CUDA's first visible device, else the CPU; `CUDA_VISIBLE_DEVICES=` keeps a training on the CPU."""
    return torch.device(_kind())


def _kind() -> str:
    return "cuda" if torch.cuda.is_available() else "cpu"
