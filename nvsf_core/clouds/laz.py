"""Writes point clouds as LAZ, by laspy with lazrs: an extra."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.errors import MissingLibraryError

_SCALE_M = 0.0001
"""Step of the stored coordinates: LAS holds whole numbers."""


def require_laspy() -> Any:
    """The module `laspy`, with its compressor.

    Raises:
        MissingLibraryError: It or lazrs is not installed; the message says how.
    """
    try:
        importlib.import_module("lazrs")
        return importlib.import_module("laspy")
    except ImportError as error:
        raise MissingLibraryError(
            "exports: the format laz needs the packages laspy and lazrs, which are not here: pip install "
            "'nvsf[exports]'"
        ) from error


def write_laz(
    path: Path, rows: np.ndarray, ring: np.ndarray, offset_s: np.ndarray, support: np.ndarray
) -> None:
    """Write a scan as LAZ 1.4, point format 6, with the further dimensions `ring`, `time`, `support`.

    Args:
        path: The file.
        rows: (N, 4) x, y, z in metres, rounded to 0.1 mm, and intensity 0..1, stored as 0..65535.
        ring: (N,) laser.
        offset_s: (N,) seconds after the scan's stamp.
        support: (N,) `Support`.

    Raises:
        MissingLibraryError: laspy or lazrs is not installed.
    """
    laspy = require_laspy()
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, _SCALE_M)
    header.offsets = np.zeros(3)
    # LAS 1.4 asks for this bit of point formats 6 and above, with a coordinate system or without one.
    header.global_encoding.wkt = True
    kinds = (("ring", np.uint16), ("time", np.float32), ("support", np.uint8))
    for name, kind in kinds:
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=kind))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = (rows[:, axis].astype(np.float64) for axis in range(3))
    cloud.intensity = np.rint(rows[:, 3] * 65535.0).astype(np.uint16)
    # A return's number counts from 1: one of 0 is no return for who asks for first returns.
    cloud.return_number = cloud.number_of_returns = np.ones(len(rows), np.uint8)
    cloud.ring, cloud.time, cloud.support = ring, offset_s, support
    path.parent.mkdir(parents=True, exist_ok=True)
    cloud.write(str(path), do_compress=True)
