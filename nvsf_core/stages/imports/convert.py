"""Converts a recorded drive of any readable format, a frame at a time, whole or not at all.

A frame that cannot be used is named with its reason, in `import.json` and to the caller; the others are
written. The drive appears under its name only when it is complete.
"""

import contextlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.drives.drive import AbstractDrive, DriveFacts, drive_of, require_outside
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kinds import MOST_FRAMES
from nvsf_core.drives.kitti360.scans import notes_on_brightest
from nvsf_core.drives.posed import AbstractPosedDrive
from nvsf_core.drives.validation import require_sweep_within_step
from nvsf_core.errors import DataError
from nvsf_core.sensors.lasers import is_unlike
from nvsf_core.sensors.tables import HDL_64E
from nvsf_core.stages.imports.kitti360_layout import Kitti360Target
from nvsf_core.stages.imports.odometry import found_path
from nvsf_core.stages.imports.plain_layout import PlainTarget
from nvsf_core.stages.imports.target import AbstractTarget
from nvsf_core.stages.runner.own_places import require_place_of_yours
from nvsf_core.stores.scene_store import new_folder
from nvsf_core.stores.writers import leftovers

TARGETS: dict[str, type[AbstractTarget]] = {"plain": PlainTarget, "kitti360": Kitti360Target}
"""Layouts that a drive can be written in."""
_HOLD_OUT = 10
"""Every tenth frame of the suggested catalogue is a test frame, as in the paper's moving scenes."""
_LOOKED_AT = 5
"""Scans that tell whether a sensor that is assumed is another."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Imported:
    """What was written, and what was not."""

    folder: Path
    scans: int
    images: int
    frames: int
    """Frames with a pose."""
    left_out: tuple[str, ...]
    """A line for each scan, image, pose or box that could not be used, with the reason."""
    notes: tuple[str, ...]
    """What was assumed, and how well poses were found."""


@dataclass(slots=True)
class _Scans:
    """What became of the section's scans."""

    written: int = 0
    brightest: float = 0.0
    """Intensity of the brightest return of all, 0..1."""
    refused: str = ""
    """Why the first one that is there cannot be used; empty = none was refused."""


def import_drive(
    scene: SceneEntry, out: Path, *, layout: str = "plain", progress: Callable[[str], None]
) -> Imported:
    """Convert the section of a scene's drive.

    Args:
        scene: The recorded drive, and its frames.
        out: Folder to make; it must not exist, or be empty.
        layout: One of `TARGETS`.
        progress: Receives progress lines.

    Raises:
        DataError: The drive cannot be read, nothing of it or none of its scans can be used, or `out` is taken
            or in the drive, or belongs to the outputs in NVSF_HOME.
        MissingLibraryError: Poses are to be found and KISS-ICP is not installed.
    """
    if layout not in TARGETS:
        raise DataError(f"layout: expected one of {', '.join(TARGETS)}, found {layout!r:.60}")
    if out.exists() and (not out.is_dir() or set(out.iterdir()) - set(leftovers(out))):
        raise DataError(f"{out}: expected a folder to be made, found one that is taken; name another")
    require_outside(out, [scene.root])
    require_place_of_yours(out, home_from_environment(os.environ))
    if len(range(scene.first_frame, scene.last_frame + 1)) > MOST_FRAMES:
        raise DataError(f"expected at most {MOST_FRAMES:,} frames; name a part (--first, --last)")
    try:
        with new_folder(out) as folder:
            done = _convert(scene, folder, layout, progress)
    except OSError as error:
        raise DataError(f"cannot write {out} ({error.strerror or error}); check space and rights") from error
    return replace(done, folder=out)


def _convert(scene: SceneEntry, folder: Path, layout: str, progress: Callable[[str], None]) -> Imported:
    source = drive_of(scene)
    left_out, notes = source.unread(), list[str]()
    if isinstance(source, AbstractPosedDrive) and source.pose_path() is None:
        source.given_path, words = found_path(source, progress)
        notes.append(words)
    facts = source.facts()
    require_sweep_within_step(source, facts)
    # A file of poses may be of the whole drive.
    own = {frame: pose for frame, pose in facts.poses.items() if frame in source.frames}
    facts = replace(facts, poses=own)
    if scene.is_lidar_assumed and facts.has_scans and is_unlike(HDL_64E, _some_scans_m(source)):
        facts = replace(facts, sensor="")
        notes.append(f"the scans are not of an {HDL_64E.name}: their lasers are to be found")
    target = TARGETS[layout](folder, scene, facts)
    target.path = source.path_of_section() if isinstance(source, AbstractPosedDrive) else None
    scans, images = _Scans(), 0
    for number, frame in enumerate(source.frames):
        progress(f"frame {frame}, {number} of {len(source.frames)} done")
        if frame not in facts.poses:
            left_out.append(f"pose {frame}: {source.why_no_pose(frame, facts.poses_place.name)}")
        _scan(source, facts, target, frame, scans, left_out)
        images += sum(_image(source, facts, target, name, frame, left_out) for name in target.cameras)
    if not scans.written + images:
        raise DataError(
            f"{scene.root}: expected a scan or an image that can be used, found none: "
            f"{' | '.join(left_out)!s:.600}"
        )
    # Without them the drive would be one of cameras alone, which nothing downstream doubts.
    if scans.refused and not scans.written:
        raise DataError(
            f"{scene.root}: expected a scan that can be used, found none: {scans.refused}; correct the "
            "scans, or move them away where images alone are wanted"
        )
    boxes = source.boxes()
    left_out += [f"box: {words}" for words in boxes.left_out]
    target.finish(boxes.boxes)
    left_out += target.left_out
    notes += [f"times: {facts.times.source}"] if facts.times.is_assumed else []
    notes += notes_on_brightest(scans.brightest)
    notes += [*facts.calibration.notes, *facts.notes, *boxes.notes, *target.notes, *_held_out(scene)[1]]
    done = Imported(
        folder=folder, scans=scans.written, images=images, frames=len(facts.poses), left_out=tuple(left_out),
        notes=tuple(notes),
    )  # fmt: skip
    _write_log(folder, scene, layout, target, done)
    return done


def _some_scans_m(source: AbstractDrive) -> list[np.ndarray]:
    """Points (n, 3) of a few scans that can be read."""
    found = []
    for frame in source.frames[:: max(1, len(source.frames) // _LOOKED_AT)]:
        with contextlib.suppress(DataError):
            recorded = source.find_scan(frame)
            found += [] if recorded is None else [source.parse_scan(recorded).points[:, :3]]
    return found[:_LOOKED_AT]


def _scan(
    source: AbstractDrive,
    facts: DriveFacts,
    target: AbstractTarget,
    frame: int,
    scans: _Scans,
    left_out: list[str],
) -> None:
    if not facts.has_scans:
        return
    try:
        found = source.find_scan(frame)
        if found is None:
            left_out.append(f"scan {frame}: no scan file {source.scan_name(frame)}")
            return
        scan = source.parse_scan(found)
        target.write_scan(frame, scan)
    except DataError as error:
        left_out.append(f"scan {frame}: {error}")
        scans.refused = scans.refused or left_out[-1]
        return
    scans.written += 1
    scans.brightest = max(scans.brightest, float(scan.points[:, 3].max()))


def _image(
    source: AbstractDrive,
    facts: DriveFacts,
    target: AbstractTarget,
    camera: str,
    frame: int,
    left_out: list[str],
) -> int:
    model = facts.calibration.cameras[camera].intrinsics
    try:
        found = source.find_image(camera, frame, model.width, model.height)
        if found is None:
            raise DataError(f"no image file {source.image_name(camera, frame)}")
        rgb = source.parse_image(camera, found, model.width, model.height)
    except DataError as error:
        left_out.append(f"image {camera} {frame}: {error}")
        return 0
    delay_s = source.image_delay_s(camera, frame)
    # Nominal instants, too, where the recorded ones were refused: poses and images are on one clock.
    instant_s = float(facts.times.time_s[frame - source.scene.first_frame])
    target.write_image(camera, frame, rgb, None if delay_s is None else instant_s + delay_s)
    return 1


def _write_log(folder: Path, scene: SceneEntry, layout: str, target: AbstractTarget, done: Imported) -> None:
    facts = {
        "source": str(scene.root), "kind": scene.kind, "sequence": scene.sequence, "layout": layout,
        "frames": [scene.first_frame, scene.last_frame], "clock_origin_s": target.facts.times.origin_s,
        "poses": done.frames, "scans": done.scans, "images": done.images, "left_out": list(done.left_out),
        "notes": list(done.notes),
    }  # fmt: skip
    (folder / "import.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    test, _ = _held_out(scene)
    lines = [
        "[[scene]]", f'name = "{scene.name}"', 'root = "."', *target.catalogue_lines(),
        *([] if scene.is_to_compensate else ["compensate = false"]),
        f"first_frame = {scene.first_frame}", f"last_frame = {scene.last_frame}", f"test_frames = {test}", "",
    ]  # fmt: skip
    (folder / "scenes.toml").write_text("\n".join(lines), encoding="utf-8")


def _held_out(scene: SceneEntry) -> tuple[list[int], list[str]]:
    """Test frames of the suggested catalogue, and a line where they are not the usual ones."""
    first, last = scene.first_frame, scene.last_frame
    usual = list(range(first + _HOLD_OUT // 2, last, _HOLD_OUT))
    if usual:
        return usual, []
    if last - first >= 2:
        middle = (first + last) // 2
        return [middle], [f"of so few frames one is held out for measuring: {middle} (scenes.toml)"]
    return [], ["too few frames to hold one out: nothing of this drive can be measured (scenes.toml)"]
