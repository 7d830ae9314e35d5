"""Tensors on disk as safetensors, replaced atomically; pickle is never used."""

import errno
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from nvsf_core.errors import StoreError
from nvsf_core.stores.documents import Contents, foreign, remove_left_documents, unreadable
from nvsf_core.stores.writers import temporary_of


def save_tensors(path: Path, tensors: Mapping[str, Tensor], meta: Mapping[str, Any] | None = None) -> None:
    """Write named tensors and JSON-able facts atomically: a reader sees the old file or the new one.

    Raises:
        OSError: The disk refuses; nothing is left of what was begun.
    """
    remove_left_documents(path.parent)
    temporary = temporary_of(path)
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    try:
        temporary.touch()
        mode = temporary.stat().st_mode
        save_file(contiguous, str(temporary), metadata={"json": json.dumps(dict(meta or {}))})
        # The library makes files that nobody but their owner may read; a home may be shared.
        temporary.chmod(mode)
        with temporary.open("rb") as handle:
            os.fsync(handle.fileno())
        temporary.replace(path)
    except SafetensorError as error:
        raise OSError(errno.EIO, str(error), str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and facts of a file by `save_tensors`.

    Raises:
        StoreError: The file is absent or no safetensors file.
    """
    if not path.is_file():
        raise StoreError(f"no checkpoint at {path}")
    try:
        path.open("rb").close()  # safetensors says of a file that may not be read that it is absent
        with safe_open(str(path), framework="pt") as handle:
            tensors = {name: handle.get_tensor(name) for name in handle.keys()}  # noqa: SIM118 (not a dict)
            meta: Any = json.loads((handle.metadata() or {}).get("json", "{}"))
            if not isinstance(meta, dict):
                raise TypeError(f"facts: expected an object, found {meta!r:.60}")
    except PermissionError as error:
        raise unreadable(path, error, "") from error
    except Exception as error:
        raise StoreError(
            f"{path} is no readable safetensors file ({error!r:.300}); delete it and run again"
        ) from error
    return tensors, Contents(path, meta)


@dataclass(frozen=True, slots=True)
class StoredWeights:
    """Weights and facts of a trained model, and their file."""

    tensors: dict[str, Tensor]
    facts: dict[str, Any]
    source: Path

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file by `save_tensors`.

        Raises:
            StoreError: The file is absent or no safetensors file.
        """
        return cls(*load_tensors(path), path)

    def has(self, prefix: str, /) -> bool:
        """Whether any weight's name begins with `prefix`."""
        return any(name.startswith(prefix) for name in self.tensors)

    def tensor(self, name: str, /) -> Tensor:
        """The tensor of that name.

        Raises:
            StoreError: It is absent, or a value is not finite.
        """
        if name not in self.tensors:
            raise foreign(self.source, f"expected a tensor {name!r}, found none")
        value = self.tensors[name]
        if not bool(value.isfinite().all()):
            raise foreign(self.source, f"expected finite values, found NaN or infinity in {name!r}")
        return value

    def load_into(self, model: nn.Module, prefix: str, /) -> None:
        """Load the weights whose names begin with `prefix` into a network, whose names lack it.

        Raises:
            StoreError: Names or shapes differ from the network's, or a weight is not finite.
        """
        found = {name: value for name, value in self.tensors.items() if name.startswith(prefix)}
        named = {name.removeprefix(prefix): value for name, value in found.items()}
        broken = [name for name, value in named.items() if not bool(value.isfinite().all())]
        if broken:
            raise foreign(self.source, f"expected finite weights, found NaN or infinity in {broken[0]!r}")
        try:
            model.load_state_dict(named)
        except RuntimeError as error:  # torch raises it for other names or shapes
            raise foreign(
                self.source,
                f"expected the weights of a {type(model).__name__} under {prefix!r}, found others "
                f"({error!s:.300})",
            ) from error
