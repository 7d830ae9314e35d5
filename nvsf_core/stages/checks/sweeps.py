"""The named checks of the stage `sweeps`: scans against their poses, and cameras against the scans."""

from nvsf_core.geometry.se3 import poses_in
from nvsf_core.stages.checks.declared import SWEEP_CHECKS
from nvsf_core.stages.checks.mountings import mountings_check
from nvsf_core.stages.checks.registration import agreement_check, order_check, upright_check
from nvsf_core.stages.inputs import scene_frame
from nvsf_core.stages.runner.stage import Check, Task
from nvsf_core.stores.arrays import read_arrays, read_attrs


def check_sweeps(task: Task) -> list[Check]:
    """All named checks of the sweeps in the task's folder."""
    path = task.folder / "returns.zarr"
    if read_arrays(path, "frame")["frame"].size == 0:
        return [named.not_run("this drive has no scan") for named in SWEEP_CHECKS]
    names = ("frame", "offsets", "origin_m", "direction", "range_m", "is_own_vehicle", "lidar_to_world")
    arrays = read_arrays(path, *names)
    scene_to_world = scene_frame(read_attrs(path))
    poses = poses_in(scene_to_world, arrays["lidar_to_world"])
    return [
        agreement_check(arrays, poses),
        order_check(arrays, poses),
        upright_check(arrays, poses, scene_to_world),
        mountings_check(task, arrays, scene_to_world),
    ]
