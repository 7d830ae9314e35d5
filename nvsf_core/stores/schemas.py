"""The data contract: the arrays and columns that stages publish for other stages, with type, shape and unit.

`python -m nvsf_core.stores.contract_page` prints it (docs/data_contract.md). Readers check it: arrays
by `field_faults` before and `violations` after reading, tables by `column_faults`.
"""

import fnmatch
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

CAMERA = "<camera>"
"""Placeholder of a camera's name (`image_00`, `front`) in a field's name."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One array of a Zarr group, or one column of a table."""

    name: str
    """May begin with `<camera>`: one field per camera."""
    dtype: str
    """numpy's short name (`f4`, `i8`, `u1`, `bool`), or `string`, `list<f8>` in a table."""
    shape: tuple[str | int, ...]
    """A number is an exact length; the same word means the same length in the whole group; () in a table."""
    unit: str
    """`1` = a bare number."""
    meaning: str
    optional: bool = False
    """Absent if the drive cannot provide it."""


@dataclass(frozen=True, slots=True)
class FileSpec:
    """One file or group that a stage publishes."""

    stage: str
    path: str
    """Path below `<NVSF_HOME>/<scene>/`."""
    kind: Literal["zarr", "parquet"]
    meaning: str
    fields: tuple[Entry, ...]
    attributes: str = ""
    """Attributes of the group, in words."""


def _columns(*rows: tuple[str, str, str, str]) -> tuple[Entry, ...]:
    return tuple(Entry(name, dtype, (), unit, meaning) for name, dtype, unit, meaning in rows)


_SAME: dict[str, tuple[str, ...]] = {"i8": ("f8",), "f8": ("i8",)}
"""Other types allowed for a column of numbers: its stored type depends on whether all values are whole."""
_SUPPORT = "what recorded data know of it: 0 = guessed, 1 = extrapolated, 2 = seen"
_OF_COLOUR = (
    "what recorded images know of its colour: 0 = guessed, 1 = extrapolated, 2 = seen, as the sky may be, "
    "which has no range"
)
_POSE = "4x4, row by row; an empty list where there is none"

_CLOCK = "spin, cut, lag: see `SweepClock`; absent = clockwise, cut behind"
CONTRACT: tuple[FileSpec, ...] = (
    FileSpec(
        "frames", "frames/frames.parquet", "parquet", "One row a frame of the section.",
        (
            *_columns(
                ("frame", "i8", "1", "frame number of the recording"),
                ("time_s", "f8", "s", "since the first frame"),
                ("split", "string", "", "`train` or `test` (held out)"),
                ("lidar_to_world", "list<f8>", "m", _POSE),
                ("pose_valid", "bool", "", "whether the recording has a pose for this frame"),
                ("scan_valid", "bool", "", "whether the scan can be used"),
                ("reason", "string", "", "why not; empty where it can"),
                ("checksum", "string", "", "SHA-256 of the scan file; empty where there is none"),
            ),
            Entry(
                "boxes_time_s", "f8", (), "s",
                "moment that its boxes are of, since the first frame; absent = `time_s`", optional=True,
            ),
        ),
    ),
    FileSpec(
        "frames", "frames/cameras.parquet", "parquet", "One row a frame and camera.",
        _columns(
            ("frame", "i8", "1", "frame number"),
            ("camera", "string", "", "`image_00` to `image_03`"),
            ("time_s", "f8", "s", "since the first frame: the image's own time, where images have times"),
            ("camera_to_world", "list<f8>", "m", f"rectified camera (raw for a fisheye); {_POSE}"),
            ("image_valid", "bool", "", "whether the image can be used"),
            ("reason", "string", "", "why not"),
            ("checksum", "string", "", "SHA-256 of the image file"),
        ),
    ),
    FileSpec(
        "frames", "frames/boxes.parquet", "parquet", "One row a frame and annotated object; may be empty.",
        _columns(
            ("frame", "i8", "1", "frame number"),
            ("object_id", "i8", "1", "the same object keeps it"),
            ("label", "string", "", "annotated class"),
            ("dynamic", "bool", "", "whether it moves"),
            ("box_to_world", "list<f8>", "m", "4x4; its 3x3 holds the size: unit cube, +-0.5"),
        ),
    ),
    FileSpec(
        "sweeps", "sweeps/returns.zarr", "zarr", "Every return of every valid scan as a ray at its own time.",
        (
            Entry("frame", "i8", ("scans",), "1", "frame number"),
            Entry("time_s", "f8", ("scans",), "s", "the pose's instant, since the first frame"),
            Entry("lidar_to_world", "f8", ("scans", 4, 4), "m", "true world, origin not subtracted"),
            Entry("firings", "i4", ("scans",), "1", "firings a sweep; 0 = unknown"),
            Entry("offsets", "i8", ("scans+1",), "1", "returns of scan k: offsets[k] to offsets[k+1]"),
            Entry("points_m", "f4", ("returns", 3), "m", "as recorded: sensor frame, file order"),
            Entry("intensity", "f4", ("returns",), "1", "0 to 1"),
            Entry("laser", "i2", ("returns",), "1", "0 = top; -1 = unknown"),
            Entry("firing", "i2", ("returns",), "1", "index, clockwise from behind; -1 = unknown"),
            Entry("sweep_fraction", "f4", ("returns",), "turn", "-azimuth / 2 pi of the firing, -0.5 to 0.5"),
            Entry(
                "elapsed", "f4", ("returns",), "turn",
                "sweeps after the pose's instant, as recorded; absent = `sweep_fraction`", optional=True,
            ),
            Entry("sweep_clock", "f8", ("scans", 3), "1", _CLOCK, optional=True),
            Entry("origin_m", "f4", ("returns", 3), "m", "of the ray, scene-local"),
            Entry("direction", "f4", ("returns", 3), "1", "of the ray, unit length, scene-local axes"),
            Entry("range_m", "f4", ("returns",), "m", "along that ray, without its laser's bias"),
            Entry("laser_range_bias_m", "f8", ("lasers",), "m", "what its recorded ranges are too long by"),
            Entry("laser_intensity_gain", "f8", ("lasers",), "1", "what its intensities are too high by"),
            Entry("is_own_vehicle", "bool", ("returns",), "", "whether the recording car itself was hit"),
            Entry("is_mirrored", "bool", ("returns",), "", "whether the recording car's bonnet mirrored it"),
            Entry(
                "bonnet_shape", "f8", ("terms",), "m",
                "z = c0 + c1 x + c2 y + c3 x^2 + c4 y^2, sensor's frame; absent where nothing is mirrored",
                optional=True,
            ),
            Entry(
                "own_vehicle_range_m", "f4", ("lasers", "azimuth_cells"), "m",
                "median over training scans, from the sensor's centre; 0 = not the own vehicle",
            ),
            Entry(
                "own_vehicle_intensity", "f4", ("lasers", "azimuth_cells"), "1", "median over training scans"
            ),
        ),
        "scene_to_world (4 x 4, row by row), sweep_period_s, elevation_correction_deg, laser_source, "
        "laser_evidence, compensated, sensor, sensor_table (of lasers that were found from the scans)",
    ),
    FileSpec(
        "evidence", "evidence/moving.parquet", "parquet",
        "One row a moving object that was found, without labels, and scan that saw it; may be empty.",
        _columns(
            ("object_id", "i8", "1", "from 1, the largest first"),
            ("time_s", "f8", "s", "mean time of its returns, since the first frame"),
            ("box_to_world", "list<f8>", "m", "4x4 bounds of its returns, as in `boxes.parquet`"),
        ),
    ),
    FileSpec(
        "pano", "pano/pano.zarr", "zarr", "Range images; 0 = no return.",
        (
            Entry("frame", "i8", ("scans",), "1", "frame number"),
            Entry("linear_range_m", "f4", ("scans", 66, 1030), "m", "the paper's grid"),
            Entry("linear_intensity", "f4", ("scans", 66, 1030), "1", "the paper's grid"),
            Entry("beam_range_m", "f4", ("scans", "lasers", 1030), "m", "one row a laser", optional=True),
            Entry("beam_intensity", "f4", ("scans", "lasers", 1030), "1", "one row a laser", optional=True),
        ),
        "the grids and the sensor table",
    ),
    FileSpec(
        "undistorted", "undistorted/images.zarr", "zarr", "Perspective images, one group of arrays a camera.",
        (
            Entry(f"{CAMERA}_rgb", "u1", ("images", "height", "width", 3), "1", "0 to 255", optional=True),
            Entry(f"{CAMERA}_valid", "bool", ("height", "width"), "", "the lens sees it", optional=True),
            Entry(f"{CAMERA}_frame", "i8", ("images",), "1", "frame number", optional=True),
            Entry(f"{CAMERA}_time_s", "f8", ("images",), "s", "since the first frame", optional=True),
            Entry(f"{CAMERA}_camera_to_world", "f8", ("images", 4, 4), "m", "true world", optional=True),
        ),
        "cameras: name to fx, fy, cx, cy, width, height (pixels), kind; camera_in_lidar: name to 16 numbers, "
        "4x4 row by row, m",
    ),
    FileSpec(
        "mesh", "mesh/mesh.zarr", "zarr", "The baseline's Poisson mesh; empty where none could be made.",
        (
            Entry("vertices_m", "f4", ("vertices", 3), "m", "scene-local", optional=True),
            Entry("triangles", "i4", ("triangles", 3), "1", "rows of `vertices_m`", optional=True),
            Entry("intensity", "f4", ("vertices",), "1", "0 to 1, of the nearest point", optional=True),
        ),
    ),
    FileSpec(
        "field", "field/<recipe>/<seed>/curve.parquet", "parquet",
        "Training curve; beside it `weights.safetensors` and `recipe.json`.",
        _columns(
            (
                "sensor", "string", "",
                "`lidar`, `hits`, `pano`, `depth`, `camera`; of the paper's recipes `field`, `refinement`",
            ),
            ("step", "i8", "1", "optimiser step"),
            ("seconds", "f8", "s", "spent training so far"),
            ("loss", "f8", "1", "total, weighted; each term has a column of its own beside it, unweighted"),
            ("rays_per_s", "f8", "1/s", "speed of training"),
        ),
    ),
    FileSpec(
        "novel_views", "novel_views/<recipe>/<seed>/<view>/<method>.zarr", "zarr",
        "What a method renders of a view: `model`; for the view `test`, and for views whose truth is known,"
        " also `reproject`, `copy_nearest`, `mesh`.",
        (
            Entry("frame", "i8", ("scans",), "1", "nearest recorded frame (of images, without LiDAR)"),
            Entry("time_s", "f8", ("scans",), "s", "instant of the scene, since the first frame"),
            Entry("path_time_s", "f8", ("scans",), "s", "moment of the sensor's path", optional=True),
            Entry("stamp_s", "f8", ("scans",), "s", "on the sensor's own clock", optional=True),
            Entry("number", "i8", ("scans",), "1", "of the files", optional=True),
            Entry("path_knot_s", "f8", ("knots",), "s", "of a path that is not the drive's", optional=True),
            Entry("path_to_world", "f8", ("knots", 4, 4), "m", "its poses, unmounted", optional=True),
            Entry("lidar_to_world", "f8", ("scans", 4, 4), "m", "true world; without LiDAR the pose frame"),
            Entry("offsets", "i8", ("scans+1",), "1", "returns of scan k", optional=True),
            Entry("points_m", "f4", ("returns", 3), "m", "sensor frame at firing time", optional=True),
            Entry("intensity", "f4", ("returns",), "1", "0 to 1", optional=True),
            Entry("laser", "i2", ("returns",), "1", "0 = top", optional=True),
            Entry("support", "u1", ("returns",), "1", _SUPPORT, optional=True),
            Entry("pano_range_m", "f4", ("scans", 66, 1030), "m", "0 = no return", optional=True),
            Entry("pano_intensity", "f4", ("scans", 66, 1030), "1", "0 to 1", optional=True),
            Entry("pano_hit", "f4", ("scans", 66, 1030), "1", "probability of a return", optional=True),
            Entry("ray_offsets", "i8", ("scans+1",), "1", "recorded rays of scan k", optional=True),
            Entry("ray_range_m", "f4", ("rays",), "m", "along recorded rays; inf = no answer", optional=True),
            Entry("ray_intensity", "f4", ("rays",), "1", "along recorded rays", optional=True),
            Entry("sweep_clock", "f8", ("scans", 3), "1", _CLOCK, optional=True),
            Entry("grid_firings", "i8", ("scans",), "1", "of scan k: the others are padding", optional=True),
            Entry("grid_range_m", "f4", ("scans", "lasers", "firings"), "m", "free of noise", optional=True),
            Entry("grid_hit", "f4", ("scans", "lasers", "firings"), "1", "probability", optional=True),
            Entry("grid_intensity", "f4", ("scans", "lasers", "firings"), "1", "0 to 1", optional=True),
            Entry("grid_azimuth_rad", "f4", ("scans", "lasers", "firings"), "rad", "own", optional=True),
            Entry("grid_elevation_rad", "f4", ("scans", "lasers", "firings"), "rad", "own", optional=True),
            Entry("grid_support", "u1", ("scans", "lasers", "firings"), "1", _SUPPORT, optional=True),
            Entry("lidar_render_seconds", "f8", ("scans",), "s", "a scan", optional=True),
            Entry(f"{CAMERA}_rgb", "u1", ("images", "height", "width", 3), "1", "0 to 255", optional=True),
            Entry(
                f"{CAMERA}_range_m", "f2", ("images", "height", "width"), "m",
                "length of each pixel's ray; inf or 0 = none is known, as of the sky", optional=True,
            ),
            Entry(f"{CAMERA}_support", "u1", ("images", "height", "width"), "1", _OF_COLOUR, optional=True),
            Entry(f"{CAMERA}_instance", "u2", ("images", "height", "width"), "1", "0 = none", optional=True),
            Entry(f"{CAMERA}_frame", "i8", ("images",), "1", "nearest recorded frame", optional=True),
            Entry(f"{CAMERA}_time_s", "f8", ("images",), "s", "instant of the scene", optional=True),
            Entry(f"{CAMERA}_camera_to_world", "f8", ("images", 4, 4), "m", "true world", optional=True),
            Entry(f"{CAMERA}_render_seconds", "f8", ("images",), "s", "an image", optional=True),
            Entry("train_seconds", "f8", (1,), "s", "evidence and training together"),
            Entry("peak_memory_mb", "f8", (1,), "MB", "of the training process"),
        ),
        "split, sensor (empty = no LiDAR), method, recipe, seed, cameras, parameters, model_mb, "
        "scene_to_world (4 x 4, row by row), scene_rate and path_rate "
        "(seconds of the scene and of the path in one of the sensor's), mount (4 x 4 in the path's frame, or "
        "null), sensor_max_range_m, sweep_period_s, grid_lasers (of the grid's rows), measured_range_noise_m "
        "(of the training scans), cameras_like (cameras of other intrinsics: whose place they have), "
        "camera_models, camera_in_lidar, instances (objects, labelled or found to move: the values of "
        "`<camera>_instance`)",
    ),
    FileSpec(
        "scene_metrics", "scene_metrics/<recipe>/<seed>/<view>/truth.zarr", "zarr",
        "True images of a view of the catalogue, where they are known; for measuring alone.",
        (
            Entry(f"{CAMERA}_rgb", "u1", ("images", "height", "width", 3), "1", "0 to 255", optional=True),
            Entry(f"{CAMERA}_valid", "bool", ("height", "width"), "", "the lens sees it", optional=True),
            Entry(f"{CAMERA}_frame", "i8", ("images",), "1", "frame that was asked for", optional=True),
            Entry(f"{CAMERA}_row", "i8", ("images",), "1", "row of the view's image", optional=True),
        ),
        "cameras",
    ),
    FileSpec(
        "scene_metrics", "scene_metrics/<recipe>/<seed>/metrics.parquet", "parquet",
        "One row a frame and metric; means are made by the reader.",
        _columns(
            ("scene", "string", "", "name"),
            ("split", "string", "", "`test` (held out), or a view: of known truth, or protocol `trust`"),
            ("frame", "i8", "1", "frame number"),
            ("protocol", "string", "", "`lidar4d`, `lidar4d_scan`, `raw`, `masked`, `image`, `trust`"),
            (
                "region", "string", "", "`all`, `foreground`, `background`; of exact truths `support_seen`,"
                " `support_extrapolated`, `support_guessed`; `supported`: the first two; of `trust` also"
                " `recorded_low`, `recorded_median`, `recorded_high`: values of recorded data",
            ),
            ("sensor", "string", "", "`lidar` or a camera's name"),
            ("metric", "string", "", "name with its unit"),
            ("value", "f8", "see unit", "NaN = undefined, never 0"),
            ("unit", "string", "", "`1` = a bare number"),
            ("n_valid", "i8", "1", "what the value was made from"),
            ("recipe", "string", "", "preset, or a baseline's name"),
            ("seed", "i8", "1", "of training"),
            ("train_seconds", "f8", "s", "evidence, training and refinement together"),
            ("render_seconds", "f8", "s", "of that frame and sensor; NaN for protocol `trust`"),
            ("parameters", "i8", "1", "of all networks"),
            ("model_mb", "f8", "MB", "all that rendering needs, evidence included"),
            ("peak_memory_mb", "f8", "MB", "of the training process"),
            ("commit", "string", "", "of this project"),
        ),
    ),
)  # fmt: skip


def spec_at(path: Path) -> FileSpec | None:
    """The contract of a published file, by its path on disk; None if it has none."""
    for spec in CONTRACT:
        patterns = path_patterns(spec)
        parts = path.parts[-len(patterns) :]
        if all(map(fnmatch.fnmatchcase, parts, patterns)) and len(path.parts) > len(patterns):
            return spec
    return None


def path_patterns(spec: FileSpec) -> list[str]:
    """Glob pattern of each part of the contract's path: `<recipe>` matches any name."""
    return [re.sub("<[a-z]+>", "*", part) for part in spec.path.split("/")]


def violations(spec: FileSpec, arrays: Mapping[str, np.ndarray], *, whole: bool = True) -> list[str]:
    """Violations of the contract by the arrays of a Zarr group, one sentence each; other arrays are allowed.

    If these are the `whole` group, missing ones are violations.
    """
    found: list[str] = []
    for field in spec.fields:
        named = dict(_matching(spec, field, arrays))
        if whole and not named and not field.optional:
            found.append(f"{field.name}: expected {field.dtype} {field.shape}, found nothing")
        for name, array in named.items():
            lengths = _lengths(spec, arrays, name.removesuffix(field.name.removeprefix(CAMERA)))
            found += _field_violations(field, name, array.dtype, array.shape, lengths)
    return found


def field_faults(spec: FileSpec, name: str, dtype: np.dtype, shape: tuple[int, ...]) -> list[str]:
    """Violations of the contract by one array's type and shape, known before it is read."""
    return [
        fault
        for field in spec.fields
        if name in dict(_matching(spec, field, {name: np.empty(0)}))
        for fault in _field_violations(field, name, dtype, shape, {})
    ]


def _field_violations(
    field: Entry, name: str, dtype: np.dtype, shape: tuple[int, ...], lengths: Mapping[str, int]
) -> Iterator[str]:
    if dtype != np.dtype(field.dtype):
        yield f"{name}: expected type {field.dtype}, found {dtype.str[1:]}"
    if len(shape) != len(field.shape):
        yield f"{name}: expected {len(field.shape)} axes {field.shape}, found shape {shape}"
        return
    for axis, (word, length) in enumerate(zip(field.shape, shape, strict=True)):
        expected = word if isinstance(word, int) else lengths.get(word, length)
        if length != expected:
            yield f"{name}: axis {axis} ({word}): expected {expected}, found {length}"


def column_faults(spec: FileSpec, columns: Mapping[str, str]) -> list[str]:
    """Violations of the contract by the types of a table's columns, one sentence each.

    Absent columns are no violation.

    Args:
        spec: The contract of the table.
        columns: Name to type: numpy's short name, `string`, `list<f8>`; `null` or `list<null>` if the column
            has no value.
    """
    found = []
    for field in spec.fields:
        kind = columns.get(field.name, field.dtype)
        if kind not in (field.dtype, *_SAME.get(field.dtype, ()), "null", "list<null>"):
            found.append(f"column {field.name}: expected {field.dtype}, found {kind}")
    return found


def _lengths(spec: FileSpec, arrays: Mapping[str, np.ndarray], camera: str) -> dict[str, int]:
    """Length of each named axis, by the first array that has it; each camera has its own `images` axis."""
    lengths: dict[str, int] = {}
    for field in spec.fields:
        array = arrays.get(field.name.replace(CAMERA, camera))
        if array is None or array.ndim != len(field.shape):
            continue
        for word, length in zip(field.shape, array.shape, strict=True):
            if isinstance(word, str):
                lengths.setdefault(word, length)
    if "scans" in lengths:
        lengths["scans+1"] = lengths["scans"] + 1
    return lengths


def _matching(
    spec: FileSpec, field: Entry, arrays: Mapping[str, np.ndarray]
) -> Iterator[tuple[str, np.ndarray]]:
    if not field.name.startswith(CAMERA):
        if field.name in arrays:
            yield field.name, arrays[field.name]
        return
    # A camera's name may be any; arrays that the contract names themselves can have the same ending.
    ending, own = field.name.removeprefix(CAMERA), {one.name for one in spec.fields}
    for stored, array in arrays.items():
        if stored.endswith(ending) and stored != ending and stored not in own:
            yield stored, array
