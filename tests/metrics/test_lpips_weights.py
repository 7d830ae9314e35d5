"""The weights of LPIPS, made from the files that its authors and torchvision publish."""

import pytest
import torch

from nvsf_core.errors import StoreError
from nvsf_core.metrics.lpips import require_version_0_1
from nvsf_core.metrics.lpips_file import find_weights
from nvsf_core.metrics.lpips_weights import make_lpips_weights
from nvsf_core.stores.checkpoints import load_tensors


@pytest.fixture
def published(tmp_path):
    """Heads and backbone as they are published: other names, a classifier, and heads of four dimensions."""
    path = find_weights()
    if path is None:
        pytest.skip("no LPIPS weights on this machine (NVSF_LPIPS_WEIGHTS)")
    tensors, _ = load_tensors(path)
    backbone = {name: value for name, value in tensors.items() if name.startswith("features.")}
    torch.save(backbone | {"classifier.1.bias": torch.zeros(1000)}, tmp_path / "backbone.pth")
    heads = {f"lin{i}.model.1.weight": tensors[f"lin.{i}"].view(1, -1, 1, 1) for i in range(7)}
    torch.save(heads, tmp_path / "heads.pth")
    return tmp_path


def test_they_are_version_0_1_s_to_the_last_bit(published):
    make_lpips_weights(published / "heads.pth", published / "backbone.pth", published / "made.safetensors")
    require_version_0_1(load_tensors(published / "made.safetensors")[0], "made")


def test_other_numbers_are_refused_and_nothing_is_written(published):
    heads = torch.load(published / "heads.pth", weights_only=True)
    heads["lin0.model.1.weight"] += 1e-3
    torch.save(heads, published / "heads.pth")
    with pytest.raises(StoreError, match=r"heads\.pth and .*backbone\.pth: expected the numbers"):
        make_lpips_weights(published / "heads.pth", published / "backbone.pth", published / "made")
    assert not (published / "made").exists()


def test_a_file_that_is_none_of_torch_is_named(tmp_path):
    (tmp_path / "heads.pth").write_bytes(b"not tensors")
    with pytest.raises(StoreError, match=r"backbone\.pth"):
        make_lpips_weights(tmp_path / "heads.pth", tmp_path / "backbone.pth", tmp_path / "made")
