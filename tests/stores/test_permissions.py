"""A stored file that this user may not read is not called damaged: deleting it would lose a whole one."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from nvsf_core.errors import StoreError
from nvsf_core.stores.arrays import read_arrays, write_arrays
from nvsf_core.stores.checkpoints import load_tensors, save_tensors
from nvsf_core.stores.documents import read_document, write_document
from nvsf_core.stores.tables import read_table, write_table

KINDS: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "a.json": (lambda path: write_document(path, {"a": 1}), read_document),
    "a.parquet": (lambda path: write_table(path, {"a": [1]}), read_table),
    "a.safetensors": (lambda path: save_tensors(path, {"a": torch.zeros(1)}, {}), load_tensors),
    "a.zarr": (lambda path: write_arrays(path, {"a": np.zeros(2)}), lambda path: read_arrays(path, "a")),
}


@pytest.mark.parametrize("name", KINDS)
def test_a_file_without_permission_is_not_called_damaged(tmp_path: Path, name: str) -> None:
    write, read = KINDS[name]
    path = tmp_path / name
    write(path)
    read(path)
    closed = [one for one in path.rglob("*") if one.is_file()] if path.is_dir() else [path]
    for one in closed:
        one.chmod(0)
    if os.access(closed[0], os.R_OK):
        pytest.skip("this user, as root, may read what nobody may")
    with pytest.raises(StoreError, match=r"permission denied; it may well be whole") as refused:
        read(path)
    assert "delete" not in str(refused.value) and "damaged" not in str(refused.value)
