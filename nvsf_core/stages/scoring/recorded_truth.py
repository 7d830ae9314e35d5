"""True images of a view that were recorded, for example by a second camera; its catalogue names them."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nvsf_core.drives.drive import drive_of
from nvsf_core.drives.entries import ViewEntry
from nvsf_core.drives.kitti360.images import read_image
from nvsf_core.drives.view_truth import truth_files
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.scoring.view_images import TrueImages
from nvsf_core.stages.undistorted import camera_of
from nvsf_core.stages.views.view import stored_plan
from nvsf_core.stores.arrays import read_arrays, read_attrs
from nvsf_core.stores.documents import read_document
from nvsf_core.stores.tables import read_rows


def recorded_truth(task: Task, path: Path, view: ViewEntry) -> Iterator[TrueImages]:
    """The true images that a view's entry in the catalogue names, camera by camera.

    They are undistorted as their camera's recorded images are. A file's number is that of the frame at whose
    time the view's sensors are: on a path of its own, this is not the recorded frame nearest in place.

    Raises:
        DataError: A folder or a file is absent, or is no image of its camera's size.
    """
    calibrations = read_document(task.store.require("frames") / "drive.json")["cameras"]
    shown, drive = read_attrs(path).get("cameras", []), drive_of(task.scene)
    frames = _asked_frames(task, path)
    for camera, files in truth_files(task.scene, view).items():
        row = np.flatnonzero(np.isin(frames, list(files)))
        if camera not in shown or len(row) == 0:
            which = "" if camera not in shown else ", of a frame whose true one is known"
            task.progress(
                f"[{task.scene.name}] scene_metrics: view {view.name} has no image of {camera}{which}; not "
                "measured"
            )
            continue
        width, height = int(calibrations[camera]["width"]), int(calibrations[camera]["height"])
        undistorter, _ = camera_of(camera, calibrations[camera])
        images = [
            drive.rectified(camera, read_image(files[frame], width, height)) for frame in frames[row].tolist()
        ]
        valid = read_arrays(task.store.require("undistorted") / "images.zarr", f"{camera}_valid")
        yield TrueImages(
            camera=camera, row=row, frame=frames[row], valid=valid[f"{camera}_valid"],
            rgb=np.stack([one if undistorter is None else undistorter.apply(one) for one in images]),
        )  # fmt: skip


def _asked_frames(task: Task, path: Path) -> np.ndarray:
    """(n,) int64 frames at whose times a stored view of `frames` has its sensors, instant by instant."""
    posed = [row for row in read_rows(task.store.require("frames") / "frames.parquet") if row["pose_valid"]]
    apart_s = np.abs(np.array([row["time_s"] for row in posed])[None] - stored_plan(path).moments_s[:, None])
    return np.array([row["frame"] for row in posed], np.int64)[apart_s.argmin(axis=1)]
