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
from nvsf_core.stores.arrays import read_arrays, read_attrs
from nvsf_core.stores.documents import read_document


def recorded_truth(task: Task, path: Path, view: ViewEntry) -> Iterator[TrueImages]:
    """The true images that a view's entry in the catalogue names, camera by camera.

    They are undistorted as their camera's recorded images are, and belong to the view's images of the same
    frame numbers.

    Args:
        task: Task of the stage, for the drive's calibration and for progress.
        path: Zarr group of the model's view, for its frames and cameras.
        view: The view's entry in the catalogue.

    Raises:
        DataError: A folder or a file is absent, or is no image of its camera's size.
    """
    calibrations = read_document(task.store.require("frames") / "drive.json")["cameras"]
    shown, drive = read_attrs(path).get("cameras", []), drive_of(task.scene)
    for camera, files in truth_files(task.scene, view).items():
        if camera not in shown:
            task.progress(
                f"[{task.scene.name}] scene_metrics: view {view.name} has no image of {camera}, not measured"
            )
            continue
        frames = read_arrays(path, f"{camera}_frame")[f"{camera}_frame"]
        row = np.flatnonzero(np.isin(frames, list(files)))
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
