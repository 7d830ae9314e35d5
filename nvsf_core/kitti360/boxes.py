"""Annotated 3-D boxes, read from KITTI-360's XML with entities and DTDs refused."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import iterparse

from nvsf_core.errors import DataError
from nvsf_core.kitti360.calibration import parse_numbers

STATIC_FRAME = -1
"""The `frame` of a box that does not move."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """One annotated box: for a moving object, its place in one frame."""

    frame: int
    """Frame number, or -1 for a box that stands all the time."""
    object_id: int
    """semanticId * 1000 + instanceId: the same number is the same object."""
    label: str
    dynamic: bool
    box_to_world: np.ndarray
    """(4, 4) float64: the unit cube [-0.5, 0.5]^3 to world; the 3x3 part holds the size as scale."""


def read_boxes(path: Path, first_frame: int, last_frame: int) -> list[Box]:
    """Boxes of the frames `first_frame..last_frame`, and the static ones annotated around them.

    Raises:
        DataError: The file is no plain XML, or a box lacks or garbles a field.
    """
    boxes: list[Box] = []
    depth = 0
    try:
        for event, element in iterparse(str(path), events=("start", "end"), forbid_dtd=True):
            depth += 1 if event == "start" else -1
            if event == "end" and depth == 1:
                if element.find("transform") is not None and _is_wanted(element, first_frame, last_frame):
                    boxes.append(_box(element))
                element.clear()
    except (ParseError, DefusedXmlException, OSError) as error:
        raise DataError(f"cannot read boxes {path} ({error!r}); restore the file of the drive") from error
    except ValueError as error:
        raise DataError(f"{path}, element {element.tag}: {error}; restore the file of the drive") from error
    return boxes


def _is_wanted(element: Element, first_frame: int, last_frame: int) -> bool:
    frame = int(_text(element, "timestamp"))
    if frame != STATIC_FRAME:
        return first_frame <= frame <= last_frame
    start, end = element.findtext("start_frame"), element.findtext("end_frame")
    if start is None or end is None:
        return True
    return int(start) <= last_frame and first_frame <= int(end)


def _box(element: Element) -> Box:
    transform = _opencv_matrix(element, "transform", (4, 4))
    frame = int(_text(element, "timestamp"))
    dynamic = element.findtext("dynamic")
    return Box(
        frame=frame,
        object_id=int(_text(element, "semanticId")) * 1000 + int(_text(element, "instanceId")),
        label=(element.findtext("label") or "unknown").strip(),
        dynamic=frame != STATIC_FRAME if dynamic is None else bool(int(dynamic)),
        box_to_world=transform @ _unit_cube_to_vertices(element),
    )


def _unit_cube_to_vertices(element: Element) -> np.ndarray:
    """The bounding box of `vertices` as a transform of the unit cube: the identity for ordinary boxes."""
    matrix = np.eye(4)
    if element.find("vertices") is None:
        return matrix
    vertices = _opencv_matrix(element, "vertices", None)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    matrix[:3, :3] = np.diag(high - low)
    matrix[:3, 3] = (low + high) / 2.0
    return matrix


def _opencv_matrix(element: Element, name: str, shape: tuple[int, int] | None) -> np.ndarray:
    node: Any = element.find(name)
    found = (int(_text(node, "rows")), int(_text(node, "cols")))
    if found != (shape or (found[0], 3)) or found[0] < 1:
        raise ValueError(f"{name}: expected a matrix of shape {shape or 'n x 3'}, found {found}")
    return parse_numbers(_text(node, "data"), found[0] * found[1]).reshape(found)


def _text(element: Element, name: str) -> str:
    text = element.findtext(name)
    if text is None:
        raise ValueError(f"field {name!r} is missing")
    return text
