"""Stage `undistorted`: camera frames as pinhole images, with intrinsics and a mask of valid pixels."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nvsf_core.cameras.masks import lens_circle
from nvsf_core.cameras.undistort import Undistorter, make_undistorter
from nvsf_core.drives.drive import drive_of
from nvsf_core.errors import CalibrationError
from nvsf_core.geometry.fisheye import MeiFisheye, shown_as
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.reporting.previews import image_preview
from nvsf_core.stages.inputs import pinhole_of
from nvsf_core.stages.runner.heartbeat import sparse
from nvsf_core.stages.runner.stage import Check, StageOutput, Task
from nvsf_core.stores.arrays import write_arrays
from nvsf_core.stores.documents import read_document
from nvsf_core.stores.tables import read_rows

_EDGE_LEVELS = 4
_LEAST_EDGES = 0.02
"""Least share of edges; street images of the demo and of KITTI-360 have a quarter and more."""


def run(task: Task) -> StageOutput:
    """Rectify the images of each camera; the stage `undistorted`."""
    frames = task.store.require("frames")
    drive: dict[str, Any] = read_document(frames / "drive.json")
    rows = read_rows(frames / "cameras.parquet")
    # Without a pose the place of an image is unknown.
    usable = [row for row in rows if row["image_valid"] and len(row["camera_to_world"] or ()) == 16]
    output = StageOutput()
    arrays: dict[str, np.ndarray] = {}
    facts: dict[str, dict[str, float | int | str]] = {}
    for camera, calibration in sorted(drive["cameras"].items()):
        own = sorted((row for row in usable if row["camera"] == camera), key=lambda row: int(row["frame"]))
        if not own:
            task.progress(f"[{task.scene.name}] undistorted: {camera} has no valid image, left out")
            continue
        numbers = [int(row["frame"]) for row in own]
        images, valid, view, preview = _undistort(task, camera, calibration, own)
        arrays[f"{camera}_rgb"] = images
        arrays[f"{camera}_valid"] = valid
        arrays[f"{camera}_frame"] = np.array(numbers, np.int64)
        arrays[f"{camera}_time_s"] = np.array([row["time_s"] for row in own], np.float64)
        poses = np.array([row["camera_to_world"] for row in own], np.float64)
        arrays[f"{camera}_camera_to_world"] = poses.reshape(-1, 4, 4)
        facts[camera] = _facts(view, calibration["kind"])
        output.metadata[f"{camera}_images"] = len(own)
        output.metadata[f"{camera}_valid_share"] = round(float(valid.mean()), 4)
        (task.folder / f"{camera}.png").write_bytes(image_preview(preview))
        output.previews[camera] = f"{camera}.png"
        detail = f"{valid.mean():.1%} of the pixels show something, field {_field_deg(view):.1f} degrees"
        output.checks.append(
            Check(name=f"{camera}_shows_something", passed=bool(valid.any()), detail=detail, blocking=True)
        )
        output.checks.append(_structure_check(camera, images, valid, numbers))
    mountings = {name: drive["camera_in_lidar"][name] for name in facts}
    write_arrays(task.folder / "images.zarr", arrays, {"cameras": facts, "camera_in_lidar": mountings})
    output.metadata["cameras"] = len(facts)
    output.metadata["images_left_out"] = len(rows) - len(usable)
    return output


def _structure_check(camera: str, images: np.ndarray, valid: np.ndarray, frames: list[int]) -> Check:
    """Check that images show edges: from sky, fog or a covered lens no depth can be learned."""
    both = valid[:, 1:] & valid[:, :-1]
    bare = []
    for frame, image in zip(frames, images, strict=True):
        grey = image.max(axis=-1).astype(np.int16)
        step = np.abs(np.diff(grey, axis=1))[both]
        if np.count_nonzero(step >= _EDGE_LEVELS) < _LEAST_EDGES * max(1, len(step)):
            bare.append(frame)
    return Check(
        name=f"{camera}_sees_structure",
        passed=2 * len(bare) < len(frames),
        detail=f"{len(bare)} of {len(frames)} images are bare: neighbouring pixels differ by {_EDGE_LEVELS} "
        f"levels in less than {_LEAST_EDGES:.0%} of the places; errors of such images say little",
    )


def _undistort(
    task: Task, camera: str, calibration: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]
) -> tuple[np.ndarray, np.ndarray, Pinhole, np.ndarray]:
    """Images (n, H, W, 3) uint8, validity (H, W) bool, their pinhole camera, and a preview picture.

    `rows` are those of `cameras.parquet`, one per image.
    """
    drive = drive_of(task.scene)
    width, height = int(calibration["width"]), int(calibration["height"])
    undistorter, view = camera_of(camera, calibration)
    images = np.zeros((len(rows), view.height, view.width, 3), np.uint8)
    brightest = np.zeros((height, width, 3), np.uint8)
    say = sparse(task.progress)
    first = brightest
    for i, row in enumerate(rows):
        image = drive.read_image(camera, int(row["frame"]), width, height, row["checksum"] or "")
        first = image if i == 0 else first
        if undistorter is None:
            images[i] = image
        else:
            images[i] = undistorter.apply(image)
            brightest = np.maximum(brightest, image)
        say(f"[{task.scene.name}] undistorted: {camera} {i + 1}/{len(rows)} images")
    if undistorter is None:
        return images, np.ones((height, width), np.bool_), view, images[0]
    valid = undistorter.apply_mask(lens_circle(brightest))
    return images, valid, view, _beside(first, images[0])


def camera_of(camera: str, calibration: Mapping[str, Any]) -> tuple[Undistorter | None, Pinhole]:
    """The resampling of a fisheye's images (None for a camera without distortion), and the pinhole camera.

    Raises:
        CalibrationError: It is of neither kind.
    """
    if calibration["kind"] == "perspective":
        return None, pinhole_of(calibration)
    if calibration["kind"] != "fisheye":
        raise CalibrationError(
            f"{camera}: expected a perspective or fisheye camera in drive.json, "
            f"found {calibration['kind']!r}; run the stage `frames` again"
        )
    names = ("xi", "k1", "k2", "p1", "p2", "gamma1", "gamma2", "u0", "v0")
    values = {name: float(calibration[name]) for name in names}
    width, height = int(calibration["width"]), int(calibration["height"])
    fisheye = MeiFisheye(**values, width=width, height=height)
    view = shown_as(fisheye)
    # A third pinhole is written into KITTI-360's layout as a fisheye without distortion.
    return None if fisheye.as_pinhole else make_undistorter(fisheye, view), view


def _facts(view: Pinhole, kind: str) -> dict[str, float | int | str]:
    return {
        "fx": view.fx, "fy": view.fy, "cx": view.cx, "cy": view.cy,
        "width": view.width, "height": view.height, "kind": kind,
    }  # fmt: skip


def _field_deg(view: Pinhole) -> float:
    """Horizontal field of view in degrees, from border to border."""
    left, right = (view.cx + 0.5) / view.fx, (view.width - 0.5 - view.cx) / view.fx
    return float(np.degrees(np.arctan(left) + np.arctan(right)))


def _beside(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Two pictures side by side, the first scaled to the second's height by nearest pixels."""
    height, width = second.shape[0], round(first.shape[1] * second.shape[0] / first.shape[0])
    rows = np.arange(height) * first.shape[0] // height
    columns = np.arange(width) * first.shape[1] // width
    return np.concatenate([first[rows][:, columns], second], axis=1)
