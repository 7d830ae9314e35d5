"""What is compiled ahead is all that a drive needs."""

import pkgutil
from importlib import import_module
from pathlib import Path

from nvsf_core import kernels
from nvsf_core.stages.runner.compile_kernels import compile_kernels


def _kept() -> dict[str, Path]:
    """Where numba lists the compiled forms of each kernel that is kept on disk, by module and name."""
    found = {}
    for module in pkgutil.walk_packages(kernels.__path__, f"{kernels.__name__}."):
        if "triton" in module.name:
            continue
        for name, value in vars(import_module(module.name)).items():
            kept = getattr(getattr(value, "_cache", None), "_cache_file", None)
            if kept is not None:
                found[f"{value.py_func.__module__}.{name}"] = Path(kept._index_path)
    return found


def test_every_kernel_that_is_kept_on_disk_is_compiled_ahead() -> None:
    compile_kernels()
    kept = _kept()
    assert len(kept) > 10
    # Of a kernel that another one calls nothing is loaded where that one is kept already: the disk tells.
    assert [name for name, index in kept.items() if not index.is_file()] == []
