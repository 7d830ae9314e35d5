"""How much an output will take on the disk, estimated before it is begun from what it is made of.

Whatever is compressed counts as it is in memory: an estimate is rather too large than too small.
"""

import math
from collections import Counter
from collections.abc import Container, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from nvsf_core.demo.drive import DEMO_SEQUENCE
from nvsf_core.drives.entries import ViewEntry
from nvsf_core.drives.view_checks import moments_s
from nvsf_core.drives.view_entry import NO_SENSOR
from nvsf_core.errors import DataError
from nvsf_core.metrics.table import BASELINES
from nvsf_core.recipe.paper import EncoderSpec
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.sensors.tables import LaserTable, recorded_table
from nvsf_core.simulation.view_plan import table_of
from nvsf_core.stages.runner.record import read_record
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stores.arrays import array_layouts, read_arrays, read_attrs
from nvsf_core.stores.documents import read_document
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows

BYTES_A_RETURN = {"bin": 16, "ply": 16, "pcd": 16}
"""Of each format: four float32."""
_OTHER_FORMAT_BYTES = 40
"""Of a format that is not listed: a dozen fields, compressed or not."""
_BESIDE_BYTES = 2 + 4 + 1
"""Of a return, beside its scan: laser, time and support."""
_SAMPLED_MORE = 1.1
"""Sampled scans have up to a tenth more returns than rendered ones, and these than recorded ones."""
_DEFAULT_EXPORTS = ("bin", "ply")
_SWEEP_RETURN_BYTES = 54
"""Of a return in `sweeps`: three points of three float32, three more numbers, laser, firing and two marks."""
_RAY_BYTES = 21
"""Of a ray of a rendered grid: five float32 and its support."""
_RETURN_BYTES = 12 + 4 + 2 + 1
"""Of a rendered return: point, intensity, laser and support; of the model's there is a file, too."""
_PANO_BYTES = 66 * 1030 * 12
"""Of a sweep's range image: three float32 a pixel."""
_RECORDED_RAY_BYTES = 8
_PIXEL_BYTES = 3 + 2 + 1
"""Of a rendered pixel: colours, range and support."""
_MODEL_PIXEL_BYTES = 2 + 3 + 1
"""Of the model's, too: instance, and two PNG files."""
_BAG_PIXEL_BYTES = {"rgb": 3, "range_m": 4, "instance": 4}
_COPY_PIXEL_BYTES: Mapping[str, Mapping[str, int]] = {
    "kitti": {"rgb": 3}, "kitti360": {"rgb": 3, "instance": 2}, "nuscenes": {"rgb": 3},
    "mcap": _BAG_PIXEL_BYTES, "rosbag2": _BAG_PIXEL_BYTES,
}  # fmt: skip
"""Of a pixel's colours, depth and instance, in formats that hold images of their own."""
_GRID_PIXEL_BYTES = 2 * 4
"""Of a pixel of a range image in `pano`: range and intensity."""
_DEPTH_PIXEL_BYTES = 4
"""Of a pixel of an image's depth map, which is stored with the model."""
_TRAINED_COPIES = 5
"""Of a weight: stored, and in a checkpoint with its average and the two moments of its step."""
_NETWORKS_BYTES = 2_000_000
"""Of a model beside its grids: networks of all sensors, curves, recipe."""
_SMALL_BYTES = 2_000_000
"""Of folders, pictures and descriptions of arrays in any output."""


def sweeps_bytes(task: Task) -> int:
    """Estimated bytes of the returns that `frames` counted, in whatever format they are recorded."""
    record = read_record(task.store.require("frames")) or {}
    return int(record.get("metadata", {}).get("returns", 0)) * _SWEEP_RETURN_BYTES


def pano_bytes(task: Task) -> int:
    """Estimated bytes of the range images: the papers' grid, and one row a laser."""
    folder = task.store.require("sweeps") / "returns.zarr"
    scans = len(read_arrays(folder, "frame")["frame"])
    linear = LinearPano()
    lasers = recorded_table(read_attrs(folder)).laser_count if scans else 0
    pixels = linear.width * (linear.height + lasers)
    return _SMALL_BYTES + scans * pixels * _GRID_PIXEL_BYTES


def undistorted_bytes(task: Task) -> int:
    """Estimated bytes of all images of the drive as pinhole images of their cameras."""
    folder = task.store.require("frames")
    cameras: dict[str, Any] = read_document(folder / "drive.json")["cameras"]
    counts = Counter(row["camera"] for row in read_rows(folder / "cameras.parquet") if row["image_valid"])
    return _SMALL_BYTES + sum(
        (counts[name] * 3 + 1) * int(one["width"]) * int(one["height"]) for name, one in cameras.items()
    )


def proof_bytes(task: Task) -> int:
    """Estimated bytes of `evidence`, and of `mesh`: no more than the returns that they are made of."""
    return _SMALL_BYTES + sweeps_bytes(task)


def field_bytes(task: Task) -> int:
    """Estimated bytes of a model and its checkpoints: depth maps of the images, hash grids, networks."""
    images = array_layouts(task.store.require("undistorted") / "images.zarr")
    pixels = sum(math.prod(one.shape[:3]) for name, one in images.items() if name.endswith("_rgb"))
    weights = _NETWORKS_BYTES + _grid_bytes(task.config.recipe)
    return _SMALL_BYTES + pixels * _DEPTH_PIXEL_BYTES + _TRAINED_COPIES * weights


def novel_views_bytes(task: Task) -> int:
    """Estimated bytes of all views of a scene; one that cannot be rendered takes none."""
    drive = _Drive.of(task.store)
    held_out = sum(frame in drive.frame for frame in task.scene.test_frames)
    methods = 1 + len(BASELINES)
    one = _sweep_bytes(drive, drive.table, methods) + methods * drive.returns * _RECORDED_RAY_BYTES
    one += _shown_bytes(drive.pixels, drive.pixels)
    return held_out * one + sum(_asked_bytes(task, drive, view) for view in task.scene.views)


def dataset_bytes(task: Task) -> int:
    """Estimated bytes of all data sets of a run; views that were not rendered take none."""
    rendered = task.store.path(f"novel_views/{task.config.recipe.name}/{task.config.seed}")
    exports = {"test": _DEFAULT_EXPORTS} | {view.name: view.exports for view in task.scene.views}
    return sum(_view_bytes(rendered / name / "model.zarr", kinds) for name, kinds in exports.items())


def _grid_bytes(spec: Any) -> int:
    """Of the hash grids of a recipe or a part of one, float32."""
    if not is_dataclass(spec):
        return 0
    part: Any = spec
    tables = getattr(part, "log2_tables", (part.log2_table,) if hasattr(part, "log2_table") else ())
    entries = getattr(part, "slices", 1) * sum(2**log2 for log2 in tables)
    own = 4 * part.levels * part.features * entries if entries else 0
    parts = sum(_grid_bytes(getattr(part, one.name)) for one in fields(part))
    # The LiDAR and the cameras have an encoding each.
    return own + parts * (2 if isinstance(spec, EncoderSpec) else 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Drive:
    """What decides the size of a view: the drive's instants and sensors."""

    frame: np.ndarray
    """(m,) numbers of the frames with a pose."""
    time_s: np.ndarray
    """(m,) their times, seconds since the first frame."""
    pixels: Mapping[str, int]
    """Of an image of each camera."""
    table: LaserTable | None
    """The recording sensor; None without LiDAR."""
    rays: int
    """Of a grid of the recording sensor: its lasers by the most firings of a sweep."""
    returns: int
    """Of the fullest recorded scan."""

    @classmethod
    def of(cls, store: SceneStore) -> Self:
        """Read it from the outputs of the first stages; of arrays only the small ones."""
        rows = [row for row in read_rows(store.require("frames") / "frames.parquet") if row["pose_valid"]]
        rows.sort(key=lambda row: row["frame"])
        folder = store.require("sweeps") / "returns.zarr"
        attrs, a = read_attrs(folder), read_arrays(folder, "firings", "offsets")
        cameras = read_attrs(store.require("undistorted") / "images.zarr").get("cameras", {})
        return cls(
            frame=np.array([row["frame"] for row in rows], np.int64),
            time_s=np.array([row["time_s"] for row in rows], np.float64),
            pixels={name: int(one["width"]) * int(one["height"]) for name, one in cameras.items()},
            table=recorded_table(attrs) if len(a["firings"]) else None,
            rays=len(attrs["lasers"]) * int(a["firings"].max(initial=0)),
            returns=int(np.diff(a["offsets"]).max(initial=0)),
        )


def _asked_bytes(task: Task, drive: _Drive, view: ViewEntry) -> int:
    """Of a view of the catalogue, by all methods that render it."""
    try:
        count = len(moments_s(view, drive.frame, drive.time_s))
    except (DataError, IndexError):  # the stage says why
        return 0
    # Of the demo, whose world is known, there is a truth of everything.
    is_known = task.scene.sequence == DEMO_SEQUENCE
    table = None
    if drive.table is not None and view.sensor != NO_SENSOR:
        table = table_of(view.sensor, drive.table)
    pixels = _pixels(drive, view)
    sweep = _sweep_bytes(drive, table, 1 + is_known * len(BASELINES))
    return count * (sweep + _shown_bytes(pixels, pixels if is_known else dict(view.truth)))


def _sweep_bytes(drive: _Drive, table: LaserTable | None, methods: int) -> int:
    """Of one sweep of a sensor by some methods, with the model's file; 0 without a sensor."""
    if table is None or drive.table is None:
        return 0
    rays = returns = table.laser_count * table.firings_per_turn
    if table.name == drive.table.name:
        rays, returns = drive.rays, min(drive.rays, int(_SAMPLED_MORE * drive.returns))
    stored = rays * _RAY_BYTES + returns * _RETURN_BYTES + _PANO_BYTES
    return methods * stored + returns * BYTES_A_RETURN["bin"]


def _shown_bytes(pixels: Mapping[str, int], known: Container[str]) -> int:
    """Of an image of each camera, by the model and, where its truth is known, by all methods."""
    return sum(
        count * ((1 + (camera in known) * len(BASELINES)) * _PIXEL_BYTES + _MODEL_PIXEL_BYTES)
        for camera, count in pixels.items()
    )


def _pixels(drive: _Drive, view: ViewEntry) -> dict[str, int]:
    """Camera to pixels of an image, of the cameras that a view has."""
    is_other = view.sensor_name not in (None, NO_SENSOR, None if drive.table is None else drive.table.name)
    # As `asked_view` has it: a view with another LiDAR is about that LiDAR's data only.
    names = () if is_other or view.camera else tuple(drive.pixels)
    own = {name: drive.pixels.get(name, 0) for name in (names if view.cameras is None else view.cameras)}
    return own | {camera.name: camera.width * camera.height for camera in view.camera}


def _view_bytes(path: Path, exports: tuple[str, ...]) -> int:
    """Of a data set of a rendered view."""
    if not path.is_dir():
        return 0
    arrays = array_layouts(path)
    a_return = sum(BYTES_A_RETURN.get(kind, _OTHER_FORMAT_BYTES) for kind in exports) + _BESIDE_BYTES
    returns = len(arrays["points_m"]) if "points_m" in arrays else 0
    return int(_SAMPLED_MORE * returns * a_return) + _image_bytes(arrays, exports)


def _image_bytes(arrays: Mapping[str, np.ndarray], exports: tuple[str, ...]) -> int:
    """Of all images, depths and instances as they are in memory, a PNG takes less; and their copies."""
    cameras = [name.removesuffix("_rgb") for name in arrays if name.endswith("_rgb")]
    total = 0
    for kind in ("rgb", "range_m", "instance"):
        own = [arrays[name] for name in (f"{camera}_{kind}" for camera in cameras) if name in arrays]
        total += sum(math.prod(one.shape) * one.itemsize for one in own)
        copied = sum(_COPY_PIXEL_BYTES.get(name, {}).get(kind, 0) for name in exports)
        total += copied * sum(math.prod(one.shape[:3]) for one in own)
    return total
