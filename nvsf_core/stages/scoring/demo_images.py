"""True images of a view of the demo: rendered from its exact world.

An image is taken by the demo's own camera, at the exact position of its car (by formula, not the drive's
poses) plus the view's mounting, without noise; a fisheye's is undistorted as the recorded ones are. So the
truth of a recorded place is the recorded image, and errors compare with those of held-out frames.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.demo.cameras import demo_camera, render_image
from nvsf_core.drives.catalogue import ViewEntry
from nvsf_core.kernels.threads import in_parts
from nvsf_core.simulation.view_plan import ViewPlan
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.scoring.demo_truth import DemoTruth
from nvsf_core.stages.scoring.view_images import TrueImages
from nvsf_core.stages.undistorted import camera_of
from nvsf_core.stages.views.view import stored_plan
from nvsf_core.stores.arrays import read_arrays, read_attrs
from nvsf_core.stores.documents import read_document


def demo_images(task: Task, path: Path, view: ViewEntry, truth: DemoTruth) -> Iterator[TrueImages]:
    """The true images of a view of the demo, camera by camera."""
    calibrations = read_document(task.store.require("frames") / "drive.json")["cameras"]
    images = task.store.require("undistorted") / "images.zarr"
    plan = stored_plan(path)
    for camera in read_attrs(path).get("cameras", []):
        if camera not in calibrations:
            continue  # of other intrinsics than any that the drive's world has a camera of
        valid = read_arrays(images, f"{camera}_valid")[f"{camera}_valid"]
        yield TrueImages(
            camera=camera, row=np.arange(len(plan.time_s)), valid=valid,
            frame=read_arrays(path, f"{camera}_frame")[f"{camera}_frame"],
            rgb=_rendered(truth, camera, calibrations[camera], plan),
        )  # fmt: skip
        task.progress(
            f"[{task.scene.name}] scene_metrics: truth of {view.name}, {camera}, {len(plan.frame)} images"
        )


def _rendered(truth: DemoTruth, name: str, calibration: Mapping[str, Any], plan: ViewPlan) -> np.ndarray:
    """(n, H, W, 3) uint8 undistorted images of a view at its n instants."""
    camera = demo_camera(name, int(calibration["width"]), int(calibration["height"]))
    undistorter, _ = camera_of(name, calibration)
    poses, time_s = truth.path_to_world(plan, plan.moments_s), plan.time_s + truth.shift_s

    def image(number: int) -> np.ndarray:
        rgb = render_image(
            truth.world, camera, float(time_s[number]), plan.mount, path_to_world=poses[number]
        )
        return rgb if undistorter is None else undistorter.apply(rgb)

    return np.stack(in_parts(image, len(time_s)))
