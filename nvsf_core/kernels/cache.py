"""Where compiled kernels are kept; imported before the first of them is decorated.

Numba looks at the file of the function that was called alone: one that calls a kernel of another file would
go on with what that was before it changed. So each state of all sources here has a folder of its own.
"""

import hashlib
from pathlib import Path

import numba

_HERE = Path(__file__).parent
_SOURCES = b"".join(path.read_bytes() for path in sorted(_HERE.glob("*.py")))
COMPILED = _HERE / "__pycache__" / f"numba-{hashlib.sha256(_SOURCES).hexdigest()[:16]}"
"""Unless the environment's NUMBA_CACHE_DIR names another folder."""
numba.config.CACHE_DIR = numba.config.CACHE_DIR or str(COMPILED)
