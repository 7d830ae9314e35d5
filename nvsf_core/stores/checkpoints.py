"""Tensors on disk as safetensors, replaced atomically; no pickle is ever read."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from nvsf_core.errors import StoreError


def save_tensors(path: Path, tensors: Mapping[str, Tensor], meta: Mapping[str, Any] | None = None) -> None:
    """Write named tensors and JSON-able facts; the file at `path` is the old one or the new one."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    save_file(contiguous, str(temporary), metadata={"json": json.dumps(dict(meta or {}))})
    with temporary.open("rb") as handle:
        os.fsync(handle.fileno())
    temporary.replace(path)


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `save_tensors` wrote.

    Raises:
        StoreError: The file is absent or no safetensors file.
    """
    if not path.is_file():
        raise StoreError(f"no checkpoint at {path}")
    try:
        with safe_open(str(path), framework="pt") as handle:
            tensors = {name: handle.get_tensor(name) for name in handle.keys()}  # noqa: SIM118 (not a dict)
            meta: dict[str, Any] = json.loads((handle.metadata() or {}).get("json", "{}"))
    except Exception as error:
        raise StoreError(
            f"{path} is no readable safetensors file ({error}); delete it and run again"
        ) from error
    return tensors, meta
