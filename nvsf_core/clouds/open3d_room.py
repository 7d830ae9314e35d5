"""Imports open3d, only when it is needed: small machines lack system libraries that it links to."""

import ctypes
import importlib
import sys
from types import ModuleType
from typing import Any

from nvsf_core.errors import MissingLibraryError

_SYSTEM_PACKAGES = "libegl1 libgl1 libx11-6 libudev1 libidn2-0 libusb-1.0-0"

_DRAWING = "open3d.visualization"
NO_OPEN3D = "open3d cannot be loaded"
"""Said of all that was not made for want of it."""


def load_open3d() -> Any:
    """The open3d module without `open3d.visualization`, with libusb loaded beforehand.

    Raises:
        MissingLibraryError: open3d or one of its system libraries is absent; the message names the packages.
    """
    try:
        return importlib.import_module("open3d") if "open3d" in sys.modules else _first_import()
    except (ImportError, OSError) as error:
        raise MissingLibraryError(
            f"not run: {NO_OPEN3D} ({error}). `pip install open3d libusb-package` installs it,"
            f" `apt-get install -y {_SYSTEM_PACKAGES}` the system libraries that it links to"
        ) from error


def _first_import() -> Any:
    _preload_libusb()
    # Drawing brings dash, plotly and IPython, which take longer than all else of open3d.
    sys.modules[_DRAWING] = ModuleType(_DRAWING)
    try:
        open3d = importlib.import_module("open3d")
    finally:
        sys.modules.pop(_DRAWING, None)
    # Others in this process may draw: they get it when they ask.
    vars(open3d)["__getattr__"] = _drawing_when_asked
    return open3d


def _drawing_when_asked(name: str) -> ModuleType:
    if f"open3d.{name}" != _DRAWING:
        raise AttributeError(f"module 'open3d' has no attribute {name!r}")
    return importlib.import_module(_DRAWING)


def _preload_libusb() -> None:
    """Load libusb's symbols into the process: open3d's wheel links to it but does not include it."""
    try:
        library = importlib.import_module("libusb_package").get_library_path()
    except ImportError:
        return  # the system may have it; if not, open3d's own import says so
    if library is not None:
        ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
