"""Reading of KITTI raw's tracklets: boxes of moving and parked objects, used for scoring only.

A tracklet has one size and a pose a frame in the LiDAR's frame, of the middle of its bottom. Entities and
DTDs are refused.
"""

from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import parse

from nvsf_core.drives.kitti360.boxes import Box
from nvsf_core.drives.kitti360.text import MIB, require_regular
from nvsf_core.errors import DataError

_MOST_BYTES = 64 * MIB
_LEAST_MOVE_M = 1.0
"""Way of an object beyond which it moves; labels of parked cars jitter by some decimetres."""
_SEMANTIC_IDS = {"Car": 26, "Van": 27, "Truck": 27, "Pedestrian": 24, "Person (sitting)": 24, "Cyclist": 25,
                 "Tram": 31, "Misc": 0}  # fmt: skip
"""Cityscapes' numbers, as KITTI-360's boxes have them."""


def read_tracklets(path: Path, lidar_to_world: Mapping[int, np.ndarray]) -> tuple[list[Box], list[str]]:
    """Boxes of `tracklet_labels.xml` in the frames with a pose (4, 4), and a reason for each left out.

    Raises:
        DataError: It is no such XML, or a field of a tracklet is missing or no number.
    """
    try:
        require_regular(path, _MOST_BYTES)
        root = parse(str(path), forbid_dtd=True).getroot()
    except (ParseError, DefusedXmlException, LookupError, OSError, ValueError) as error:
        raise DataError(
            f"cannot read tracklets {path} ({error!r:.200}); restore the file, or remove it"
        ) from error
    boxes, left_out = [], []
    for number, item in enumerate(root.findall("tracklets/item")):
        label = (item.findtext("objectType") or "Misc").strip()
        try:
            found = _boxes(item, number, label, lidar_to_world)
        except ValueError as error:
            raise DataError(
                f"{path}, tracklet {number} ({label}): {error}; restore the file, or remove it"
            ) from error
        boxes += found
        if not found:
            left_out.append(f"tracklet {number} ({label}): in no frame of the section that has a pose")
    return boxes, left_out


def _boxes(item: Element, number: int, label: str, lidar_to_world: Mapping[int, np.ndarray]) -> list[Box]:
    size_m = np.array([_number(item, name) for name in ("l", "w", "h")])
    if not ((size_m > 1e-3) & (size_m < 1e3)).all():
        raise ValueError(f"expected sides of 1 mm to 1 km, found {size_m.tolist()}")
    first = int(_number(item, "first_frame"))
    placed = []
    for k, pose in enumerate(item.findall("poses/item")):
        if first + k not in lidar_to_world:
            continue
        x, y, z, yaw = (_number(pose, name) for name in ("tx", "ty", "tz", "rz"))
        box = np.eye(4)
        cosine, sine = np.cos(yaw), np.sin(yaw)
        box[:2, :2] = [[cosine, -sine], [sine, cosine]]
        box[:3, 3] = x, y, z + 0.5 * size_m[2]
        box[:3, :3] *= size_m
        placed.append((first + k, lidar_to_world[first + k] @ box))
    if not placed:
        return []
    place_m = np.array([box[:3, 3] for _, box in placed])
    moves = bool(np.linalg.norm(place_m - place_m[0], axis=1).max() > _LEAST_MOVE_M)
    object_id = 1000 * _SEMANTIC_IDS.get(label, 0) + number + 1
    return [
        Box(frame=frame, object_id=object_id, label=label.lower(), dynamic=moves, box_to_world=box)
        for frame, box in placed
    ]


def _number(element: Element, name: str) -> float:
    text = element.findtext(name)
    if text is None:
        raise ValueError(f"field {name!r} is missing")
    value = float(text)
    if not np.isfinite(value):
        raise ValueError(f"{name}: expected a finite number, found {text!r:.40}")
    return value
