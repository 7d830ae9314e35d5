"""The plan of a rendered view as it is stored beside it: what scoring and data sets need of it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.simulation.view_plan import ViewPlan
from nvsf_core.stores.arrays import array_names, read_arrays, read_attrs

_PATH = ("path_knot_s", "path_to_world")


def plan_arrays(plan: ViewPlan) -> dict[str, np.ndarray]:
    """Arrays of the data contract on a plan: its instants, and its path if it is not the drive's."""
    arrays = {
        "number": plan.number,
        "frame": plan.frame, "time_s": plan.time_s, "path_time_s": plan.moments_s, "stamp_s": plan.stamp_s,
    }  # fmt: skip
    if plan.path is not None:
        arrays["path_knot_s"] = plan.path.times_s
        arrays["path_to_world"] = plan.path.lidar_to_world
    return arrays


def plan_attrs(plan: ViewPlan) -> dict[str, Any]:
    """Attributes of the data contract on a plan."""
    mount = None if plan.mount is None else plan.mount.reshape(-1).tolist()
    return {"scene_rate": plan.scene_rate, "path_rate": plan.path_rate, "mount": mount}


def stored_plan(path: Path, attrs: Mapping[str, Any] | None = None) -> ViewPlan:
    """The plan of a stored view; its path is in the world.

    Args:
        path: Zarr group of one method's view.
        attrs: Its attributes, if they are known.
    """
    attrs = read_attrs(path) if attrs is None else attrs
    a = read_arrays(path, "frame", "time_s", "path_time_s")
    own = None
    if _PATH[0] in array_names(path, "f"):
        knots = read_arrays(path, *_PATH)
        own = Trajectory(knots["path_knot_s"], knots["path_to_world"], np.zeros(3))
    mount = None if attrs["mount"] is None else np.array(attrs["mount"], np.float64).reshape(4, 4)
    return ViewPlan(
        path.parent.name, a["frame"], a["time_s"], mount, path_time_s=a["path_time_s"], path=own,
        scene_rate=float(attrs["scene_rate"]), path_rate=float(attrs["path_rate"]),
    )  # fmt: skip
