"""Objects in a view, labelled or found to move: their boxes at its instants, and pixels that show them."""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.geometry.boxes import box_between, box_corners, inside_any
from nvsf_core.geometry.camera_fan import camera_rays
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.stages.exports.records import BoxRecord
from nvsf_core.stages.views.files import cameras_of
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows

FOUND = "dynamic"
"""Label of objects that were found to move; KITTI-360's word for what moves and has no class."""
_GROWN_M = 0.1
"""Surfaces lie on their boxes' faces, and a pixel's range is off by centimetres."""
_SAME_OBJECT_M = 0.3
"""A found object is a labelled one if its middle lies in that one's box, grown by so much on all sides."""
_CAN_MOVE = frozenset({
    "bicycle", "bus", "car", "caravan", "motorcycle", "person", "rider", "trailer", "train", "truck",
    "unknown vehicle", "cyclist", "pedestrian", "person sitting", "tram", "van", "human", "vehicle",
})  # fmt: skip
"""Classes of things that move: KITTI-360's, those of KITTI's tracklets, and nuScenes' by their first word.
Others, such as buildings, fences and hedges, have boxes that things move through."""
_WORD = re.compile(r"[A-Z]?[a-z]+")
_MOST_OBJECTS = 65_535
_SAME_S = 1e-6


def boxes_at(rows: Sequence[Mapping[str, Any]]) -> Callable[[float], list[BoxRecord]]:
    """Gives the boxes at an instant of the scene, in seconds.

    A moving object's box between two of its own lies between these as `box_between` says; it is absent before
    its first and after its last. Where a box is of another moment than the scan that shows the object, the
    motion goes on to the scan.

    Args:
        rows: One a box: object_id, label, dynamic, box_to_world and, if dynamic, time_s, and the scan's
            scan_time_s where it is another.
    """
    tracks: dict[int, list[Mapping[str, Any]]] = {}
    static: dict[int, Mapping[str, Any]] = {}
    for row in rows:
        if row["dynamic"]:
            tracks.setdefault(row["object_id"], []).append(row)
        else:
            static[row["object_id"]] = row
    for track in tracks.values():
        track.sort(key=lambda row: float(row["time_s"]))

    def at(time_s: float) -> list[BoxRecord]:
        moving = [_between(track, time_s) for track in tracks.values()]
        return [_record(row, _matrix(row)) for row in static.values()] + [
            one for one in moving if one is not None
        ]

    return at


def boxes_of(store: SceneStore) -> Callable[[float], list[BoxRecord]]:
    """Gives the boxes of a drive at an instant of the scene, in seconds.

    These are the labelled ones, and those of what was found to move without a label, as `dynamic`; their
    numbers come after the labelled ones'. A found object has a label if it lies in the box of one that moves,
    or in a static box of a class of things that can: somebody in front of a house may lie in the house's box.
    """
    labelled = _labelled(store)
    found = read_rows(store.require("evidence") / "moving.parquet")
    return boxes_at(labelled + _without_label(found, labelled))


def _without_label(
    found: Sequence[Mapping[str, Any]], labelled: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Boxes of found objects whose middle lies in boxes of labelled ones less than half of the time."""
    if not found:
        return []
    middles_m = np.stack([_matrix(row)[:3, 3] for row in found])
    static = [_matrix(row) for row in labelled if not row["dynamic"] and _can_move(row["label"])]
    # A drive has hundreds of static boxes and few that move: the static ones are asked once.
    is_labelled = inside_any(middles_m, np.array(static).reshape(-1, 4, 4), _SAME_OBJECT_M)
    at = boxes_at([row for row in labelled if row["dynamic"]])
    inside: dict[int, list[bool]] = {}
    for number, row in enumerate(found):
        boxes = np.array([one.box_to_world for one in at(float(row["time_s"]))]).reshape(-1, 4, 4)
        is_labelled[number] |= inside_any(middles_m[number : number + 1], boxes, _SAME_OBJECT_M)[0]
        inside.setdefault(row["object_id"], []).append(bool(is_labelled[number]))
    first = max((row["object_id"] for row in labelled), default=0)
    return [
        {**row, "object_id": first + row["object_id"], "label": FOUND, "dynamic": True}
        for row in found
        if np.mean(inside[row["object_id"]]) < 0.5
    ]


def _can_move(label: str) -> bool:
    """Whether a label, such as `unknownVehicle`, `person (sitting)` or `vehicle.car`, is of what can move."""
    name = label.partition(".")[0]
    return " ".join(_WORD.findall(name)).lower() in _CAN_MOVE


def _labelled(store: SceneStore) -> list[dict[str, Any]]:
    """Labelled boxes of the frames that the scene has, with their times and their scans'."""
    folder = store.require("frames")
    if not (folder / "boxes.parquet").is_file():
        return []
    times_of = {
        row["frame"]: {"time_s": row.get("boxes_time_s", row["time_s"]), "scan_time_s": row["time_s"]}
        for row in read_rows(folder / "frames.parquet")
    }
    rows = read_rows(folder / "boxes.parquet")
    known = [row for row in rows if not row["dynamic"] or row["frame"] in times_of]
    return [{**row, **times_of.get(row["frame"], {})} for row in known]


def _between(track: Sequence[Mapping[str, Any]], time_s: float) -> BoxRecord | None:
    known_s = np.array([row["time_s"] for row in track], np.float64)
    seen_s = [*known_s, *(row.get("scan_time_s", row["time_s"]) for row in track)]
    if not min(seen_s) - _SAME_S <= time_s <= max(seen_s) + _SAME_S:
        return None
    after = int(np.clip(np.searchsorted(known_s, time_s), 0, len(known_s) - 1))
    before = max(0, after - 1) if known_s[after] > time_s + _SAME_S else after
    if not known_s[0] - _SAME_S <= time_s <= known_s[-1] + _SAME_S and len(track) > 1:
        before, after = (0, 1) if time_s < known_s[0] else (-2, -1)
    length_s = known_s[after] - known_s[before]
    share = 0.0 if length_s <= 0.0 else (time_s - known_s[before]) / length_s
    return _record(track[before], box_between(_matrix(track[before]), _matrix(track[after]), share))


def _matrix(row: Mapping[str, Any]) -> np.ndarray:
    return np.array(row["box_to_world"], np.float64).reshape(4, 4)


def _record(row: Mapping[str, Any], pose: np.ndarray) -> BoxRecord:
    return BoxRecord(
        object_id=int(row["object_id"]), label=str(row["label"]), is_dynamic=bool(row["dynamic"]),
        box_to_world=pose,
    )  # fmt: skip


def instance_arrays(
    arrays: Mapping[str, np.ndarray],
    models: Mapping[str, Pinhole | MeiFisheye],
    boxes: Callable[[float], Sequence[BoxRecord]],
) -> tuple[dict[str, np.ndarray], list[dict[str, Any]]]:
    """Instance images of all cameras of a view, and what their values mean.

    A pixel is of an object if the surface that it shows lies in the object's box, grown by 10 cm; of several
    boxes the smallest counts.

    Args:
        arrays: Of the view, with the length of each pixel's ray.
        models: Of its cameras.
        boxes: Gives the objects at an instant, in seconds.

    Returns:
        `<camera>_instance` (n, H, W) uint16, 0 = none, and a row a value: `value`, `object_id`, `label`,
        `dynamic`. Both are empty if there is no object.

    Raises:
        DataError: There are more objects than values.
    """
    shown_by = cameras_of(arrays)
    moments = np.concatenate([arrays["time_s"], *(arrays[f"{name}_time_s"] for name in shown_by)])
    at = {time_s: list(boxes(time_s)) for time_s in dict.fromkeys(moments.tolist())}
    known = {box.object_id: box for there in at.values() for box in there}
    if not known:
        return {}, []
    if len(known) > _MOST_OBJECTS:
        raise DataError(f"instance images: expected at most {_MOST_OBJECTS:,} objects, found {len(known):,}")
    value_of = {one: number for number, one in enumerate(sorted(known), start=1)}
    table = [
        {"value": value, "object_id": one, "label": known[one].label, "dynamic": known[one].is_dynamic}
        for one, value in value_of.items()
    ]
    found = {}
    for camera in shown_by:
        rays, _ = camera_rays(models[camera])
        shown = []
        for index, time_s in enumerate(arrays[f"{camera}_time_s"].tolist()):
            pose = arrays[f"{camera}_camera_to_world"][index]
            range_m = arrays[f"{camera}_range_m"][index].astype(np.float64)
            shown.append(_image(models[camera], rays, range_m, pose, at[time_s], value_of))
        found[f"{camera}_instance"] = np.stack(shown)
    return found, table


def _image(
    model: Pinhole | MeiFisheye, rays: np.ndarray, range_m: np.ndarray, pose: np.ndarray,
    boxes: Sequence[BoxRecord], value_of: Mapping[int, int],
) -> np.ndarray:  # fmt: skip
    """One instance image (H, W) uint16; the largest boxes first, so that smaller ones lie above them."""
    shown = np.zeros(range_m.shape, np.uint16)
    is_known = np.isfinite(range_m) & (range_m > 0.0)
    points_m = np.where(is_known[..., None], rays * np.where(is_known, range_m, 0.0)[..., None], np.inf)
    for box in sorted(boxes, key=lambda one: -abs(np.linalg.det(one.box_to_world[:3, :3]))):
        in_camera = invert_pose(pose) @ box.box_to_world
        part = _window(model, in_camera)
        if part is None:
            continue
        # Half of the grown box's diagonal: farther pixels are not looked at twice.
        reach_m = 0.5 * float(np.linalg.norm(in_camera[:3, :3])) + 2.0 * _GROWN_M
        near = (np.abs(points_m[part] - in_camera[:3, 3]) <= reach_m).all(axis=-1)
        rows, columns = np.nonzero(near)
        inside = inside_any(points_m[part][near], in_camera[None], _GROWN_M)
        shown[part][rows[inside], columns[inside]] = value_of[box.object_id]
    return shown


def _window(model: Pinhole | MeiFisheye, in_camera: np.ndarray) -> tuple[slice, slice] | None:
    """Rows and columns that a box (4, 4) can be seen in; None if it cannot be seen."""
    everything = slice(0, model.height), slice(0, model.width)
    if not isinstance(model, Pinhole):
        return everything
    grown = in_camera.copy()
    edges_m = np.linalg.norm(grown[:3, :3], axis=0)
    grown[:3, :3] *= 1.0 + 2.0 * _GROWN_M / edges_m
    corners_m = box_corners(grown[None])[0]
    if (corners_m[:, 2] <= 0.0).all():
        return None
    if (corners_m[:, 2] <= 0.05).any():
        return everything
    pixels, _ = model.project(corners_m)
    size = np.array([model.width, model.height])
    low = np.clip(np.floor(pixels.min(axis=0)), 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, size).astype(int)
    if (high <= low).any():
        return None
    return slice(low[1], high[1]), slice(low[0], high[0])


def object_ids(instance: np.ndarray, table: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """Object of each pixel of an instance image (H, W) as int32; 0 = none."""
    known = np.zeros(len(table) + 1, np.int32)
    for row in table:
        known[row["value"]] = row["object_id"]
    return np.asarray(known[instance])


def depth_m(model: Pinhole | MeiFisheye, range_m: np.ndarray) -> np.ndarray:
    """Depth (H, W) float32 along the optical axis, of a fisheye along the ray, metres; 0 = not known.

    Of the lengths (H, W) of the pixels' rays, of which infinite ones are not known either.
    """
    known = np.where(np.isfinite(range_m) & (range_m > 0.0), range_m, 0.0).astype(np.float64)
    if isinstance(model, Pinhole):
        known *= camera_rays(model)[0][..., 2]
    return known.astype(np.float32)
