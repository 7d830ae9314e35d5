"""Which class reads a scene's drive, by the scene's `kind`; each format is one folder beside this file."""

import importlib

from nvsf_core.drives.drive import AbstractDrive
from nvsf_core.drives.entries import SceneEntry

_READERS = {
    "kitti360": "nvsf_core.drives.kitti360.source:Kitti360Drive",
    "plain": "nvsf_core.drives.plain.source:PlainDrive",
    "kitti_odometry": "nvsf_core.drives.kitti.odometry:KittiOdometryDrive",
    "kitti_raw": "nvsf_core.drives.kitti.raw:KittiRawDrive",
    "bag": "nvsf_core.drives.bags.source:BagDrive",
}
"""Imported when a drive is read: images are decoded by a library that takes long to load."""


def drive_of(scene: SceneEntry) -> AbstractDrive:
    """The reader of a scene's drive; nothing is opened yet."""
    module, _, name = _READERS[scene.kind].partition(":")
    reader: type[AbstractDrive] = getattr(importlib.import_module(module), name)
    return reader(scene)
