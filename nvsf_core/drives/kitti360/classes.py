"""KITTI-360's classes of objects: the numbers of its images, and those of its boxes, which are others.

Images of instances have Cityscapes' numbers. Boxes have numbers of their own (`kittiId` in
`kitti360scripts/helpers/labels.py`), which that package turns into Cityscapes'.
"""

import re

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
_SAME = {"pedestrian": "person", "cyclist": "rider", "van": "truck", "tram": "train"}
_OF_BOX = {of_box: of_image for of_image, of_box in _CLASSES.values()}
_NOT_KNOWN = _CLASSES["unknownobject"][1]


def class_of(label: str, of_box: int) -> int:
    """Number in images of a box's class; by its name, where that is known, as some writers mix the numbers.

    Args:
        label: As the box has it.
        of_box: Its `semanticId`; where no class has it, it is returned.
    """
    known = _CLASSES.get(_name(label))
    return _OF_BOX.get(of_box, of_box) if known is None else known[0]


def number_in_boxes(label: str) -> int:
    """`semanticId` of a box; that of an unknown object where KITTI-360 has no such class."""
    return _CLASSES.get(_name(label), (0, _NOT_KNOWN))[1]


def _name(label: str) -> str:
    name = re.sub("[^a-z]", "", label.lower())
    return _SAME.get(name, name)
