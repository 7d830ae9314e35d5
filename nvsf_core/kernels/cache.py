"""Where compiled kernels are kept; imported before numba is, which reads it from the environment.

Numba looks at the file of the function that was called alone: one that calls a kernel of another file would
go on with what that was before it changed. So each state of all sources here has a folder of its own. What is
kept also refers to the named tuples that kernels were called with, by their modules: these are sources, too.
"""

import hashlib
import os
import sys
from pathlib import Path

_OURS = "nvsf-kernels-"
_HERE = Path(__file__).parent
TUPLES = ("geometry/voxels.py", "fields/lidar_field.py")
"""Files of the core, outside this folder, whose named tuples kernels take."""
_FILES = (*sorted(_HERE.rglob("*.py")), *(_HERE.parent / name for name in TUPLES))
_SOURCES = b"".join(str(path.relative_to(_HERE.parent)).encode() + path.read_bytes() for path in _FILES)
COMPILED = _HERE / "__pycache__" / f"{_OURS}{hashlib.sha256(_SOURCES).hexdigest()[:16]}"
"""The folder, unless NUMBA_CACHE_DIR names one that no parent process of ours has set."""

if Path(os.environ.get("NUMBA_CACHE_DIR", _OURS)).name.startswith(_OURS):
    os.environ["NUMBA_CACHE_DIR"] = str(COMPILED)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(COMPILED)
