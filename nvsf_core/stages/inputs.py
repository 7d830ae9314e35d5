"""Read the outputs of earlier stages as the `Recording` that models are trained on."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import poses_in
from nvsf_core.recording.drive import LidarRecording, LinearPanos, Recording, Sweeps
from nvsf_core.recording.images import CameraImages, CameraRecording
from nvsf_core.sensors.sweep import trajectory_of
from nvsf_core.sensors.tables import recorded_table
from nvsf_core.stores.arrays import read_arrays, read_attrs
from nvsf_core.stores.documents import read_document
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows


def read_sweeps(store: SceneStore) -> Sweeps | None:
    """Read the output of the stage `sweeps`; None for a drive without LiDAR."""
    folder = store.require("sweeps") / "returns.zarr"
    arrays, attrs = read_arrays(folder), read_attrs(folder)
    if len(arrays["frame"]) == 0:
        return None
    rows = read_rows(store.require("frames") / "frames.parquet")
    training = {row["frame"] for row in rows if row["split"] == "train"}
    table = replace(
        recorded_table(attrs),
        range_bias_m=arrays["laser_range_bias_m"],
        intensity_gain=arrays["laser_intensity_gain"],
    )
    return Sweeps(
        arrays=arrays,
        is_training=np.isin(arrays["frame"], list(training)),
        trajectory=trajectory_of(rows, scene_frame(attrs)),
        period_s=float(attrs["sweep_period_s"]) if attrs["compensated"] else 0.0,
        table=table,
        elevation_correction_rad=float(np.deg2rad(attrs["elevation_correction_deg"])),
    )


def scene_frame(facts: Mapping[str, Any]) -> np.ndarray:
    """(4, 4) float64 pose of the scene's frame in the world, from stored `scene_to_world`, row by row.

    Raises:
        DataError: They are not 16 numbers.
    """
    numbers = np.array(facts["scene_to_world"], np.float64)
    if numbers.shape != (16,):
        raise DataError(f"scene_to_world: expected 16 numbers, found {numbers.shape}; run frames again")
    return numbers.reshape(4, 4)


def clock_origin_s(store: SceneStore) -> float | None:
    """Seconds from 1970-01-01 to 0 s of the scene, its first frame; None = the drive has no date."""
    found = read_document(store.require("frames") / "drive.json").get("clock_origin_s")
    return None if found is None else float(found)


def pinhole_of(facts: Mapping[str, Any]) -> Pinhole:
    """The camera of stored `fx`, `fy`, `cx`, `cy`, `width` and `height`, all in pixels."""
    fx, fy, cx, cy = (float(facts[key]) for key in ("fx", "fy", "cx", "cy"))
    return Pinhole(fx=fx, fy=fy, cx=cx, cy=cy, width=int(facts["width"]), height=int(facts["height"]))


def read_evidence(store: SceneStore) -> SceneEvidence | None:
    """Read the output of the stage `evidence`; None for a drive without LiDAR."""
    arrays = read_arrays(store.require("evidence") / "evidence.zarr")
    return SceneEvidence.from_arrays(arrays) if arrays else None


def read_recording(store: SceneStore) -> Recording:
    """Read the outputs of the stages up to `evidence`.

    Raises:
        DataError: There is neither a scan nor a training image.
        StoreError: The output of a stage is absent.
    """
    frames = store.require("frames")
    rows = sorted(read_rows(frames / "frames.parquet"), key=lambda row: row["frame"])
    posed = [row for row in rows if row["pose_valid"]]
    scene_to_world = scene_frame(read_document(frames / "drive.json"))
    sweeps, evidence = read_sweeps(store), read_evidence(store)
    lidar = (
        None
        if sweeps is None or evidence is None
        else LidarRecording(sweeps=sweeps, evidence=evidence, read_panos=lambda: _read_panos(store))
    )
    cameras = _read_cameras(store, rows, scene_to_world)
    if lidar is None and not cameras:
        raise DataError(
            f"scene {store.scene}: expected scans or training images, found neither; see why frames are left "
            "out in the table of the stage `frames`"
        )
    return Recording(
        lidar=lidar,
        cameras=cameras,
        trajectory=trajectory_of(rows, scene_to_world),
        posed_frame=np.array([row["frame"] for row in posed], np.int64),
        posed_time_s=np.array([row["time_s"] for row in posed], np.float64),
    )


def _read_panos(store: SceneStore) -> LinearPanos:
    a = read_arrays(store.require("pano") / "pano.zarr", "frame", "linear_range_m", "linear_intensity")
    return LinearPanos(a["frame"], a["linear_range_m"], a["linear_intensity"])


def _read_cameras(
    store: SceneStore, rows: list[dict[str, object]], scene_to_world: np.ndarray
) -> dict[str, CameraRecording]:
    """The cameras that have a training image, by name."""
    folder = store.require("undistorted") / "images.zarr"
    row_of = {row["frame"]: row for row in rows}
    found = {}
    attrs = read_attrs(folder)
    for name, facts in attrs["cameras"].items():
        names = [f"{name}_{part}" for part in ("rgb", "valid", "frame", "time_s", "camera_to_world")]
        rgb, valid, frame, time_s, pose = (read_arrays(folder, *names)[key] for key in names)
        used = np.array([row_of[number]["split"] == "train" for number in frame.tolist()], np.bool_)
        if not used.any():
            continue
        local, seen = poses_in(scene_to_world, pose), np.flatnonzero(valid.reshape(-1))
        found[name] = CameraRecording(
            training=CameraImages(pinhole_of(facts), rgb[used], local[used], seen),
            training_time_s=time_s[used],
            training_frame=frame[used],
            recorded_frame=frame,
            recorded_time_s=time_s,
            recorded_pose=local,
            in_lidar=np.array(attrs["camera_in_lidar"][name], np.float64).reshape(4, 4),
        )
    return found
