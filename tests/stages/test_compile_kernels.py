"""What is compiled ahead is all that a drive needs."""

import pkgutil
from importlib import import_module

from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

from nvsf_core import kernels
from nvsf_core.stages.compile_kernels import compile_kernels


def _kept() -> dict[str, Dispatcher]:
    """Kernels whose compiled form is kept on disk, by module and name."""
    found = {}
    for module in pkgutil.iter_modules(kernels.__path__, f"{kernels.__name__}."):
        if "triton" in module.name:
            continue
        for name, value in vars(import_module(module.name)).items():
            if isinstance(value, Dispatcher) and not isinstance(value._cache, NullCache):
                found[f"{value.py_func.__module__}.{name}"] = value
    return found


def test_every_kernel_that_is_kept_on_disk_is_compiled_ahead() -> None:
    compile_kernels()
    kept = _kept()
    assert len(kept) > 10
    assert [name for name, kernel in kept.items() if not kernel.signatures] == []
