"""Where compiled kernels are kept; imported before numba is, which reads it from the environment.

Numba looks at the file of the function that was called alone: one that calls a kernel of another file would
go on with what that was before it changed. So each state of all sources here has a folder of its own.
"""

import hashlib
import os
import sys
from pathlib import Path

_OURS = "nvsf-kernels-"
_HERE = Path(__file__).parent
_SOURCES = b"".join(path.read_bytes() for path in sorted(_HERE.rglob("*.py")))
COMPILED = _HERE / "__pycache__" / f"{_OURS}{hashlib.sha256(_SOURCES).hexdigest()[:16]}"
"""The folder, unless NUMBA_CACHE_DIR names one that no parent process of ours has set."""

if Path(os.environ.get("NUMBA_CACHE_DIR", _OURS)).name.startswith(_OURS):
    os.environ["NUMBA_CACHE_DIR"] = str(COMPILED)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(COMPILED)
