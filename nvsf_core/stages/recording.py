"""What training and rendering read of a recorded drive: scans with their evidence, images, and all poses."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.evidence.moving.object_votes import ObjectVotes
from nvsf_core.evidence.moving.objects import NearObjects
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.stages.evidence import Sweeps, read_evidence, read_sweeps, trajectory_of
from nvsf_core.stores.arrays import read_arrays, read_attrs
from nvsf_core.stores.documents import read_document
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows
from nvsf_core.training.pixels import CameraImages


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarRecording:
    """The scans, and what the training ones prove."""

    sweeps: Sweeps
    evidence: SceneEvidence

    @property
    def far_m(self) -> float:
        """How far a simulated ray is followed."""
        return float(self.sweeps.table.max_range_m)

    @property
    def object_votes(self) -> ObjectVotes:
        """Tells how often the scans saw a place on a moving object return."""
        sweeps, evidence = self.sweeps, self.evidence
        return ObjectVotes(
            evidence.prior, evidence.lasers, sweeps.trajectory, sweeps.table, sweeps.elevation_correction_rad
        )

    def moving(self) -> NearObjects | None:
        """What moves, ready to be asked for about any time; None where nothing does."""
        dynamic = self.evidence.dynamic
        return None if dynamic is None else NearObjects(dynamic.objects, self.object_votes)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRecording:
    """One camera of the drive."""

    training: CameraImages
    """At least one image."""
    training_time_s: np.ndarray
    """(n,) of the training images."""
    recorded_frame: np.ndarray
    """(m,) frame numbers with an image, held-out ones included."""
    in_lidar: np.ndarray
    """(4, 4) camera to the drive's LiDAR frame: the mounting."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """A drive with LiDAR, cameras, or both; everything scene-local but for `scene_origin_m`."""

    lidar: LidarRecording | None
    cameras: dict[str, CameraRecording]
    trajectory: Trajectory
    """Of the LiDAR's frame, which a camera-only drive has by its calibration or as the pose frame."""
    scene_origin_m: np.ndarray
    """(3,) float64, in the world."""
    posed_frame: np.ndarray
    """(p,) int64 ascending: frames with a pose, recorded by whatever sensor."""
    posed_time_s: np.ndarray
    """(p,) float64."""


def read_recording(store: SceneStore) -> Recording:
    """Read what the stages up to `evidence` published.

    Raises:
        DataError: There is neither a scan nor a training image.
        StoreError: A stage's output is absent.
    """
    frames = store.require("frames")
    rows = sorted(read_rows(frames / "frames.parquet"), key=lambda row: row["frame"])
    posed = [row for row in rows if row["pose_valid"]]
    origin_m = np.array(read_document(frames / "drive.json")["scene_origin_m"], np.float64)
    sweeps, evidence = read_sweeps(store), read_evidence(store)
    lidar = None if sweeps is None or evidence is None else LidarRecording(sweeps=sweeps, evidence=evidence)
    cameras = _read_cameras(store, rows, origin_m)
    if lidar is None and not cameras:
        raise DataError(
            f"scene {store.scene}: expected scans or training images, found neither; see why frames are left "
            "out in the table of the stage `frames`"
        )
    return Recording(
        lidar=lidar,
        cameras=cameras,
        trajectory=trajectory_of(rows, origin_m),
        scene_origin_m=origin_m,
        posed_frame=np.array([row["frame"] for row in posed], np.int64),
        posed_time_s=np.array([row["time_s"] for row in posed], np.float64),
    )


def _read_cameras(
    store: SceneStore, rows: list[dict[str, object]], scene_origin_m: np.ndarray
) -> dict[str, CameraRecording]:
    """The cameras that have a training image, by name."""
    folder = store.require("undistorted") / "images.zarr"
    row_of = {row["frame"]: row for row in rows}
    found = {}
    for name, facts in read_attrs(folder)["cameras"].items():
        names = [f"{name}_{part}" for part in ("rgb", "valid", "frame", "camera_to_world")]
        rgb, valid, frame, pose = (read_arrays(folder, *names)[key] for key in names)
        used = np.array([row_of[number]["split"] == "train" for number in frame.tolist()], np.bool_)
        if not used.any():
            continue
        local = pose[used].copy()
        local[:, :3, 3] -= scene_origin_m
        pinhole = Pinhole(**{key: facts[key] for key in ("fx", "fy", "cx", "cy", "width", "height")})
        lidar_to_world = np.array(row_of[int(frame[0])]["lidar_to_world"], np.float64).reshape(4, 4)
        found[name] = CameraRecording(
            training=CameraImages(pinhole, rgb[used], local, np.flatnonzero(valid.reshape(-1))),
            training_time_s=np.array([row_of[number]["time_s"] for number in frame[used].tolist()]),
            recorded_frame=frame,
            in_lidar=np.linalg.inv(lidar_to_world) @ pose[0],
        )
    return found
