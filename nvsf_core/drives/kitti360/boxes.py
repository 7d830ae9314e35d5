"""Reading of annotated 3-D boxes from KITTI-360's XML; entities and DTDs are refused.

Images of instances have Cityscapes' class numbers. Boxes have numbers of their own (`kittiId` in
`kitti360scripts/helpers/labels.py`), which that package turns into Cityscapes'.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import iterparse

from nvsf_core.drives.kitti360.layout import LAST_FRAME
from nvsf_core.drives.kitti360.text import FARTHEST_M, MIB, parse_numbers, require_regular
from nvsf_core.errors import DataError

STATIC_FRAME = -1
"""`frame` of a static box."""
_MOST_BYTES = 512 * MIB
"""Largest file. A box has 3 kB, and all drives of KITTI-360 together have 70,000."""
_MOST_BOXES, _MOST_PARTS = 200_000, 100
"""Most boxes of a file and most elements of a box, which has 20."""
_LONGEST_TOKEN_BYTES = 4 * MIB
_MOST_ROWS = 100_000
"""Most vertices of one object."""
_MOST_COLUMNS = 4
_MOST_ID = 1_000_000
_LONGEST_NUMBER = 20
_DEEPEST = 8
"""Deepest nesting; a box's numbers are at 4. The parser keeps nested elements until the last one closes."""
_LEAST_VOLUME = 0.1
_SIDES_M = (1e-3, 1e3)
"""Shortest and longest side of an object in a street."""
_CLASSES = {
    "building": (11, 11), "wall": (12, 7), "fence": (13, 8), "guardrail": (14, 30), "bridge": (15, 31),
    "tunnel": (16, 32), "pole": (17, 21), "trafficlight": (19, 23), "trafficsign": (20, 24),
    "vegetation": (21, 5), "person": (24, 19), "rider": (25, 20), "car": (26, 13), "truck": (27, 14),
    "bus": (28, 34), "caravan": (29, 16), "trailer": (30, 15), "train": (31, 33), "motorcycle": (32, 17),
    "bicycle": (33, 18), "garage": (34, 12), "gate": (35, 6), "stop": (36, 29), "smallpole": (37, 22),
    "lamp": (38, 25), "trashbin": (39, 26), "vendingmachine": (40, 27), "box": (41, 28),
    "unknownconstruction": (42, 35), "unknownvehicle": (43, 36), "unknownobject": (44, 37),
}  # fmt: skip
"""Number in images and number in boxes, by the name in small letters."""
_SAME = {
    "pedestrian": "person", "personsitting": "person", "cyclist": "rider", "van": "truck", "tram": "train",
}  # fmt: skip
"""Other data sets' names, as KITTI's, in small letters."""
_OF_BOX = {of_box: of_image for of_image, of_box in _CLASSES.values()}
_NOT_KNOWN = _CLASSES["unknownobject"][1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """One annotated box: of a static object, or of a moving object in one frame."""

    frame: int
    """Frame number, or -1 for a static box."""
    object_id: int
    """Cityscapes' number of its class * 1000 + instanceId, as in images: one number is one object."""
    label: str
    dynamic: bool
    box_to_world: np.ndarray
    """(4, 4) float64, unit cube [-0.5, 0.5]^3 to world; the 3x3 part includes the size as scale."""


def read_boxes(path: Path, first_frame: int, last_frame: int) -> tuple[list[Box], list[str]]:
    """Read the moving boxes of the frames `first_frame..last_frame`, and the static ones around them.

    Returns:
        The boxes, and a reason for each box that was left out, as no object in a street can have it.

    Raises:
        DataError: The file is not plain XML or too large, or a field of a box is missing or damaged.
    """
    boxes: list[Box] = []
    left_out: list[str] = []
    place = "before its first element"
    try:
        require_regular(path, _MOST_BYTES)
        _require_short_tokens(path)
        for element in _children(path):
            place = f"element {element.tag}"
            if _is_box(element) and _is_wanted(element, first_frame, last_frame):
                box = _box(element)
                fault = _fault(box.box_to_world)
                if fault is None:
                    boxes.append(box)
                else:
                    left_out.append(f"{element.tag} {box.object_id} in frame {box.frame}: {fault}")
    # An encoding that Python does not know raises a LookupError.
    except (ParseError, DefusedXmlException, LookupError, OSError) as error:
        raise DataError(
            f"cannot read boxes {path} ({error!r:.300}); restore the file of the drive"
        ) from error
    except ValueError as error:
        raise DataError(f"{path}, {place}: {error}; restore the file of the drive, or remove it") from error
    return boxes, left_out


def _children(path: Path) -> Iterator[Element]:
    """The root's children one by one; none is kept in memory.

    Raises:
        ValueError: Elements are nested too deep, or there are too many of them.
    """
    depth, count, parts = 0, 0, 0
    root: Element | None = None
    for event, element in iterparse(str(path), events=("start", "end"), forbid_dtd=True):
        root = element if root is None else root
        depth += 1 if event == "start" else -1
        parts += event == "start"
        if depth > _DEEPEST or parts > _MOST_PARTS or count > _MOST_BOXES:
            raise ValueError(
                f"expected at most {_MOST_BOXES:,} boxes of {_MOST_PARTS} elements, {_DEEPEST} deep"
            )
        if event == "end" and depth == 1:
            yield element
            root.clear()
            count, parts = count + 1, 0


def _require_short_tokens(path: Path) -> None:
    """Refuse tokens that a parser would keep in memory: a comment of a gigabyte, a million attributes.

    Raises:
        ValueError: There are too many bytes between two `>`.
    """
    run = 0
    with path.open("rb") as handle:
        while block := handle.read(MIB):
            lengths = [len(part) for part in block.split(b">")]
            if max(run + lengths[0], *lengths[1:], 0) > _LONGEST_TOKEN_BYTES:
                raise ValueError(f"expected at most {_LONGEST_TOKEN_BYTES:,} bytes from one `>` to the next")
            run = lengths[-1] + (run if len(lengths) == 1 else 0)


def _is_box(element: Element) -> bool:
    """Whether an element has any field of a box; a file may also have other elements."""
    return any(
        element.find(name) is not None for name in ("transform", "semanticId", "timestamp", "vertices")
    )


def _is_wanted(element: Element, first_frame: int, last_frame: int) -> bool:
    """Whether a box is of the section, or static and annotated in a part of it."""
    frame = _frame_of(element)
    if frame != STATIC_FRAME:
        return first_frame <= frame <= last_frame
    if element.find("start_frame") is None or element.find("end_frame") is None:
        return True
    start, end = (_integer(element, name, -1, LAST_FRAME) for name in ("start_frame", "end_frame"))
    return start <= last_frame and first_frame <= end


def _frame_of(element: Element) -> int:
    return _integer(element, "timestamp", STATIC_FRAME, LAST_FRAME)


def _integer(element: Element, name: str, least: int, most: int) -> int:
    """A field's whole number, from `least` to `most`."""
    text = _text(element, name).strip()
    # Python reads `1_0` and digits of any script; no drive writes them.
    is_plain = text.isascii() and text.removeprefix("-").isdecimal() and len(text) <= _LONGEST_NUMBER
    if not is_plain or not least <= int(text) <= most:
        raise ValueError(f"{name}: expected a whole number from {least} to {most}, found {text!r:.60}")
    return int(text)


def _box(element: Element) -> Box:
    frame = _frame_of(element)
    is_dynamic = frame != STATIC_FRAME
    if element.find("dynamic") is not None:
        is_dynamic = bool(_integer(element, "dynamic", 0, 1))
    semantic, instance = (_integer(element, name, 0, _MOST_ID) for name in ("semanticId", "instanceId"))
    label = (element.findtext("label") or "unknown").strip()
    return Box(
        frame=frame,
        object_id=class_of(label, semantic) * 1000 + instance,
        label=label,
        dynamic=is_dynamic,
        box_to_world=_opencv_matrix(element, "transform", (4, 4)) @ _unit_cube_to_vertices(element),
    )


def _fault(box_to_world: np.ndarray) -> str | None:
    """Why a transform (4, 4) is impossible: flat, sheared, of wrong size or place; None if it is possible."""
    least_m, most_m = _SIDES_M
    sides_m = np.linalg.norm(box_to_world[:3, :3], axis=0)
    if not ((sides_m >= least_m) & (sides_m <= most_m)).all():
        return f"transform: expected sides of {least_m:g} to {most_m:g} m, found {sides_m}"
    # Of axes of length 1: 1 for a box, 0 for one without volume.
    volume = abs(float(np.linalg.det(box_to_world[:3, :3] / sides_m)))
    if volume < _LEAST_VOLUME:
        return f"transform: expected three different axes, found a volume of {volume:.3g} of a box's"
    if np.abs(box_to_world[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        return f"transform: expected the last row 0 0 0 1, found {box_to_world[3]}"
    if np.abs(box_to_world[:3, 3]).max() > FARTHEST_M:
        return f"transform: expected a place within {FARTHEST_M:g} m, found {box_to_world[:3, 3]}"
    return None


def _unit_cube_to_vertices(element: Element) -> np.ndarray:
    """(4, 4) unit cube to the bounding box of `vertices`: the identity for ordinary boxes."""
    matrix = np.eye(4)
    if element.find("vertices") is None:
        return matrix
    vertices = _opencv_matrix(element, "vertices", None)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    matrix[:3, :3] = np.diag(high - low)
    matrix[:3, 3] = (low + high) / 2.0
    return matrix


def _opencv_matrix(element: Element, name: str, shape: tuple[int, int] | None) -> np.ndarray:
    """A field's matrix of that shape; None = n x 3."""
    node: Any = element.find(name)
    if node is None:
        raise ValueError(f"field {name!r} is missing")
    found = (_integer(node, "rows", 1, _MOST_ROWS), _integer(node, "cols", 1, _MOST_COLUMNS))
    if found != (shape or (found[0], 3)):
        raise ValueError(f"{name}: expected a matrix of shape {shape or 'n x 3'}, found {found}")
    return parse_numbers(_text(node, "data"), found[0] * found[1]).reshape(found)


def _text(element: Element, name: str) -> str:
    text = element.findtext(name)
    if text is None:
        raise ValueError(f"field {name!r} is missing")
    return text


def class_of(label: str, of_box: int) -> int:
    """Number in images of a box's class; by its name, where that is known, as some writers mix the numbers.

    `of_box` is its `semanticId`; where no class has it, it is returned.
    """
    known = _CLASSES.get(_name(label))
    return _OF_BOX.get(of_box, of_box) if known is None else known[0]


def number_in_boxes(label: str) -> int:
    """`semanticId` of a box; that of an unknown object where KITTI-360 has no such class."""
    return _CLASSES.get(_name(label), (0, _NOT_KNOWN))[1]


def _name(label: str) -> str:
    name = re.sub("[^a-z]", "", label.lower())
    return _SAME.get(name, name)
