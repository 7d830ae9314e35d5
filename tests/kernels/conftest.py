import pytest
import torch


@pytest.fixture(scope="session")
def device():
    """Where Triton's kernels run: interpreted where there is no CUDA device."""
    # Triton itself without the variable, or nothing else in this process could compile; our modules with it.
    import triton  # noqa: F401

    if torch.cuda.is_available():
        return "cuda"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRITON_INTERPRET", "1")
        from nvsf_core.kernels import composite_triton  # noqa: F401
        from nvsf_core.kernels.encodings import hash_grid_triton, planes_triton  # noqa: F401
    assert hash_grid_triton.is_interpreted()
    return "cpu"
