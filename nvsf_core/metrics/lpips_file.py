"""Where the weights of LPIPS lie. Without torch: who only asks whether they are there need not load it."""

import os
from pathlib import Path

from nvsf_core.errors import StoreError

WEIGHTS_VARIABLE = "NVSF_LPIPS_WEIGHTS"
WEIGHTS_NAME = "lpips_squeeze_v0.1.safetensors"
NO_WEIGHTS = "no LPIPS weights"
"""Beginning of the reason of each value that was not measured for want of them."""


def find_weights() -> Path | None:
    """File named by `NVSF_LPIPS_WEIGHTS`, else in `../shared/weights/` beside the checkout; None if absent.

    Raises:
        StoreError: The variable names a file that does not exist.
    """
    named = os.environ.get(WEIGHTS_VARIABLE)
    if named:
        path = Path(named)
        if not path.is_file():
            raise StoreError(f"{WEIGHTS_VARIABLE}={named}: no such file; unset it or name {WEIGHTS_NAME}")
        return path
    path = Path(__file__).resolve().parents[3] / "shared" / "weights" / WEIGHTS_NAME
    return path if path.is_file() else None
