"""Files of tensors."""

import os
from pathlib import Path

import pytest
import torch

from nvsf_core.stores.checkpoints import load_tensors, save_tensors


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_weights_may_be_read_by_whoever_may_read_other_files(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        save_tensors(tmp_path / "weights.safetensors", {"a": torch.arange(3.0)}, {"steps": 3})
        (tmp_path / "other").touch()
    finally:
        os.umask(before)
    modes = {path.name: path.stat().st_mode for path in tmp_path.iterdir()}
    assert set(modes) == {"weights.safetensors", "other"}
    assert modes["weights.safetensors"] == modes["other"]
    tensors, facts = load_tensors(tmp_path / "weights.safetensors")
    assert tensors["a"].tolist() == [0.0, 1.0, 2.0] and facts["steps"] == 3
