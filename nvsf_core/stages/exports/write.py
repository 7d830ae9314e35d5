"""Writes a data set: scans and images in each format that its view asks for, and the manifest's rows."""

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.clouds.laz import write_laz
from nvsf_core.drives.kitti360.scans import write_column
from nvsf_core.drives.kitti360.writer import write_grey
from nvsf_core.rendering.rendered import Support
from nvsf_core.stages.exports.card import JSON_NAME, MARKDOWN_NAME, write_card
from nvsf_core.stages.exports.kitti import kitti_cameras, write_kitti
from nvsf_core.stages.exports.kitti360 import kitti360_cameras, write_kitti360
from nvsf_core.stages.exports.manifest import CHECKSUMS, MANIFEST_NAME, write_manifest
from nvsf_core.stages.exports.nuscenes import nuscenes_channels, write_nuscenes
from nvsf_core.stages.exports.of_view import RenderedView
from nvsf_core.stages.exports.records import BoxRecord, CameraRecord, DataSet, ScanRecord
from nvsf_core.stages.exports.ros import write_mcap, write_rosbag2
from nvsf_core.stages.views.files import cameras_of, write_images, write_scans
from nvsf_core.stages.views.instances import depth_m
from nvsf_core.stages.views.view import camera_models
from nvsf_core.stores.checksums import file_checksums
from nvsf_core.stores.writers import temporary_of

SCHEMA_VERSION = 3
"""Of the manifest and the files that it names."""
DEPTH_UNIT_M = 1.0 / 256.0
"""Of depth images, as KITTI has it; 0 = not known, or beyond 256 m."""
_MOST_STEPS = 65_535
_CLOUDS = ("bin", "ply", "pcd")
WHOLE: Mapping[str, Callable[[Path, DataSet], None]] = {
    "kitti": write_kitti, "kitti360": write_kitti360, "mcap": write_mcap,
    "nuscenes": write_nuscenes, "rosbag2": write_rosbag2,
}  # fmt: skip
"""Formats that hold a whole data set in a folder of their own."""

_NAMED: Mapping[str, Callable[[Mapping[str, CameraRecord]], dict[str, str]]] = {
    "kitti": kitti_cameras, "kitti360": kitti360_cameras, "nuscenes": nuscenes_channels,
}  # fmt: skip
"""Formats that have names of their own for cameras: camera to its name there."""


def write_data_set(
    folder: Path, view: RenderedView, boxes: Callable[[float], list[BoxRecord]]
) -> dict[str, Any]:
    """Write all files of a data set; the manifest's entries on them.

    `boxes` gives the objects at an instant of the scene, in seconds.
    """
    a = view.arrays
    scans = [_scan(folder, view, index) for index in range(len(a["time_s"]))] if "points_m" in a else []
    images = _images(folder, view)
    data = view.data_set(boxes)
    for name in view.entry.exports:
        if name in WHOLE:
            WHOLE[name](folder, data)
    return {
        "schema_version": SCHEMA_VERSION,
        "sensor": view.attrs["sensor"],
        "sweep_period_s": float(view.attrs.get("sweep_period_s", 0.0)),
        "scans": scans,
        "images": images,
        "cameras": _cameras(view),
        "camera_names": {
            name: _camera_names(name, data.cameras, cameras_of(a))
            for name in view.entry.exports
            if name in WHOLE
        },
        "boxes": _boxes(view, boxes),
        "instances": view.attrs["instances"],
    }


def finish_data_set(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write the card, then the manifest with the checksums of all other files."""
    write_card(folder, manifest)
    write_manifest(folder, {**manifest, CHECKSUMS: file_checksums(folder)})


def rewrite_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Replace a data set's manifest and card, each at once; all other files stay as they are.

    The manifest keeps the time of the one before: it says when the data set was made. The new entries have
    the checksums of the files that stay.
    """
    made = (folder / MANIFEST_NAME).stat()
    # What a killed process leaves of it is removed when the next is published beside it.
    new = temporary_of(folder)
    new.mkdir()
    try:
        write_card(new, manifest)
        write_manifest(new, {**manifest, CHECKSUMS: {**manifest[CHECKSUMS], **file_checksums(new)}})
        os.utime(new / MANIFEST_NAME, ns=(made.st_atime_ns, made.st_mtime_ns))
        for name in (JSON_NAME, MARKDOWN_NAME, MANIFEST_NAME):
            (new / name).replace(folder / name)
    finally:
        shutil.rmtree(new, ignore_errors=True)


def _scan(folder: Path, view: RenderedView, index: int) -> dict[str, Any]:
    """Write one scan and what lies beside it; its row of the manifest."""
    scan, exports, a = view.scan(index), view.entry.exports, view.arrays
    clouds = [kind for kind in _CLOUDS if kind in exports]
    (files,) = write_scans(folder, [scan.number], [scan.rows], clouds)
    if "laz" in exports:
        files["laz"] = f"velodyne_points/laz/{scan.number:010d}.laz"
        write_laz(folder / files["laz"], scan.rows, scan.ring, scan.offset_s, scan.support)
    files |= _beside(folder, scan)
    return {
        "number": scan.number,
        "files": files,
        "returns": len(scan.rows),
        **_support_counts(scan.support),
        "nearest_frame": int(a["frame"][index]),
        "time_s": scan.time_s,
        "stamp_s": scan.stamp_s,
        "lidar_to_world": scan.lidar_to_world.reshape(-1).tolist(),
    }


def _beside(folder: Path, scan: ScanRecord) -> dict[str, str]:
    """Write ring, time and support of a scan's points as files beside it."""
    files = {name: f"velodyne_points/{name}/{scan.number:010d}.bin" for name in scan.beside}
    for name, values in scan.beside.items():
        write_column(folder / files[name], values)
    return files


def _support_counts(support: np.ndarray) -> dict[str, int]:
    """Returns or pixels of each support, under the name of its region."""
    return {one.region: int(np.count_nonzero(support == one)) for one in Support}


def _images(folder: Path, view: RenderedView) -> list[dict[str, Any]]:
    """Write every rendered image as PNG; returns one manifest row per image."""
    rows: list[dict[str, Any]] = []
    a = view.arrays
    for camera, index, number, file in write_images(folder, a):
        height, width = a[f"{camera}_rgb"][index].shape[:2]
        row = {
            "camera": camera, "number": number, "file": file, "pixels": height * width,
            "nearest_frame": int(a[f"{camera}_frame"][index]),
        }  # fmt: skip
        row |= _pixels(folder, view, camera, index, number)
        if f"{camera}_support" in a:
            row["support"] = f"{camera}/support/{number:010d}.png"
            row |= _support_counts(a[f"{camera}_support"][index])
        if np.array_equal(a[f"{camera}_frame"], a["frame"]):
            row |= view.image_times(camera, index)
        row["camera_to_world"] = a[f"{camera}_camera_to_world"][index].reshape(-1).tolist()
        rows.append(row)
    return rows


def _pixels(folder: Path, view: RenderedView, camera: str, index: int, number: int) -> dict[str, str]:
    """Write depth and instances of an image's pixels as PNG of 16 bits; files by kind."""
    files = {"depth": f"{camera}/depth/{number:010d}.png"}
    ranges_m = view.arrays[f"{camera}_range_m"][index]
    steps = np.rint(depth_m(camera_models(view.attrs)[camera], ranges_m) / DEPTH_UNIT_M)
    steps = np.where(steps > _MOST_STEPS, 0, steps).astype(np.uint16)
    write_grey(folder / files["depth"], steps, np.uint16)
    if f"{camera}_instance" in view.arrays:
        files["instance"] = f"{camera}/instance/{number:010d}.png"
        write_grey(folder / files["instance"], view.arrays[f"{camera}_instance"][index], np.uint16)
    return files


def _cameras(view: RenderedView) -> dict[str, Any]:
    """Model and mounting of each camera."""
    mounts = view.attrs["camera_in_lidar"]
    return {
        name: {
            **facts,
            "camera_in_lidar": mounts[name],
            "depth_unit_m": DEPTH_UNIT_M,
            "depth_along": "optical axis" if facts["kind"] == "pinhole" else "ray",
        }
        for name, facts in view.attrs["camera_models"].items()
    }


def _camera_names(
    exported: str, cameras: Mapping[str, CameraRecord], rendered: Sequence[str]
) -> dict[str, str | None]:
    """Name of each rendered camera in a format that holds a whole data set; None where it is left out."""
    found = _NAMED[exported](cameras) if exported in _NAMED else {name: name for name in cameras}
    return {name: found.get(name) for name in rendered}


def _boxes(view: RenderedView, boxes: Callable[[float], list[BoxRecord]]) -> list[dict[str, Any]]:
    """A row for each object and instant; static objects have one row, of no instant."""
    found: dict[tuple[int, int | None], dict[str, Any]] = {}
    for index, number in enumerate(view.numbers):
        for box in boxes(float(view.arrays["time_s"][index])):
            own = number if box.is_dynamic else None
            found[box.object_id, own] = {
                "number": own, "object_id": box.object_id, "label": box.label, "dynamic": box.is_dynamic,
                "box_to_world": box.box_to_world.reshape(-1).tolist(),
            }  # fmt: skip
    return list(found.values())
