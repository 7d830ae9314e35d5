"""A device that is not the CPU on a machine without one: tensors there compute on the CPU and say otherwise.

It bears the name `meta`, the one name besides the CPU's that every build of torch knows; unlike meta tensors
these hold numbers. What CUDA refuses is refused: tensors of two devices in one operation, an array made of a
tensor there, a CPU generator that draws there. What it cannot show: CUDA's arithmetic, speed and memory.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_flatten, tree_map

OTHER = torch.device("meta")
_MOVES = ("_to_copy", "copy_")
_INDEXING = ("index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index")
"""Operations whose indices may lie on the CPU, as for CUDA."""


class _Elsewhere(torch.Tensor):
    """A CPU tensor that says it lies on `OTHER`."""

    here: torch.Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, here: torch.Tensor) -> "_Elsewhere":
        found = torch.Tensor._make_wrapper_subclass(
            cls, here.size(), strides=here.stride(), storage_offset=here.storage_offset(), dtype=here.dtype,
            device=OTHER,
        )  # fmt: skip
        found.here = here
        return found

    @classmethod
    def __torch_dispatch__(
        cls, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        return _run(func, args, kwargs or {})


class _Mode(TorchDispatchMode):
    """Makes tensors there, too, not only from others there."""

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        return _run(func, args, kwargs or {})


class _Data(TorchFunctionMode):
    """Brings numbers of Python there, which no meta tensor would keep, and back."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if func is torch.Tensor.tolist and isinstance(args[0], _Elsewhere):
            return args[0].here.tolist()
        if func is torch.Tensor.new_tensor and args[0].device == OTHER:
            return torch.tensor(*args[1:], dtype=kwargs.get("dtype", args[0].dtype)).to(OTHER)
        if func in (torch.tensor, torch.as_tensor) and torch.device(kwargs.get("device") or "cpu") == OTHER:
            return func(*args, **kwargs | {"device": "cpu"}).to(OTHER)
        return func(*args, **kwargs)


def _run(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    name = func.overloadpacket.__name__
    given = tree_flatten((args, kwargs))[0]
    is_there = any(isinstance(one, _Elsewhere) for one in given)
    if is_there and name not in _MOVES:
        checked = tree_flatten((args[0], args[2:]))[0] if name in _INDEXING else given
        for one in checked:
            if isinstance(one, torch.Tensor) and not isinstance(one, _Elsewhere) and one.dim() > 0:
                raise RuntimeError(
                    f"{func}: expected all tensors on one device, found {tuple(one.shape)} on the CPU"
                )
    if kwargs.get("device") is not None:
        is_there = torch.device(kwargs["device"]) == OTHER
        kwargs = kwargs | {"device": torch.device("cpu")}
    if is_there and any(isinstance(one, torch.Generator) for one in given):
        raise RuntimeError(f"{func}: expected a generator of the device, found the CPU's")
    here = tree_map(lambda one: one.here if isinstance(one, _Elsewhere) else one, (args, kwargs))
    with _disable_current_modes():
        found = func(*here[0], **here[1])
    if name.endswith("_") and isinstance(found, torch.Tensor):
        return args[0]
    return (
        tree_map(lambda one: _Elsewhere(one) if isinstance(one, torch.Tensor) else one, found)
        if is_there
        else found
    )


@contextmanager
def other_device() -> Iterator[torch.device]:
    """Within, tensors may lie on the device that is given, and trainings choose it."""
    with pytest.MonkeyPatch.context() as patch, _Data(), _Mode():
        patch.setattr("nvsf_core.models.family._kind", lambda: OTHER.type)
        yield OTHER
