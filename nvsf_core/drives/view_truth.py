"""Files of true images of a view, which a catalogue names: found and looked at before anything is trained."""

from collections.abc import Iterable
from pathlib import Path

from nvsf_core.drives.catalogue import SceneEntry, ViewEntry
from nvsf_core.drives.drive import drive_of, has_data
from nvsf_core.drives.entries import KITTI360
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.plain.layout import IMAGE_KINDS, numbered_files
from nvsf_core.drives.view_checks import asked_frames
from nvsf_core.errors import DataError

_PNG_HEADER_BYTES = 24
"""Signature, length and name of the first chunk, then columns and rows, four bytes each."""


def truth_files(scene: SceneEntry, view: ViewEntry) -> dict[str, dict[int, Path]]:
    """Camera to frame number to file, of the true images of a view.

    If the view asks for `all` frames, those that have an image; else each of its frames must have one.

    Raises:
        DataError: A folder or an image is absent.
    """
    found: dict[str, dict[int, Path]] = {}
    for camera, named in view.truth:
        folder = scene.root / named
        where = f"scene {scene.name}, view {view.name}: truth of {camera}"
        if not folder.is_dir():
            raise DataError(
                f"{where}: expected a folder of images at {folder}, found none; correct `truth` in the "
                "catalogue, or leave it out"
            )
        is_all = view.frames == "all"
        frames = range(scene.first_frame, scene.last_frame + 1) if is_all else map(int, view.frames)
        files = _files(scene, folder, frames)
        there = {frame: file for frame, file in files.items() if file.is_file()}
        absent = sorted(set(files) - set(there))
        if not there or (absent and not is_all):
            example = files[absent[0]].name
            raise DataError(
                f"{where}: expected images of frames {absent!s:.100} in {folder}, found none, as {example} "
                "would be; add them, or ask for the `frames` that have one"
            )
        found[camera] = there
    return found


def _files(scene: SceneEntry, folder: Path, frames: Iterable[int]) -> dict[int, Path]:
    """Frame number to image, there or not, of the names and kinds that the reader of the drive accepts."""
    others = {} if scene.kind == KITTI360 else numbered_files(folder, IMAGE_KINDS)
    files = {frame: folder / f"{frame:010d}.png" for frame in frames}
    return {frame: file if file.is_file() else others.get(frame, file) for frame, file in files.items()}


def require_truth(scene: SceneEntry) -> None:
    """Refuse views whose true images are absent, of none of their frames, or not of the recorded ones' size.

    Raises:
        DataError: There is such a view; the message names it, its camera, the file and both sizes.
    """
    if not any(view.truth for view in scene.views) or not has_data(scene):
        return
    layout = DriveLayout(scene.root, scene.sequence)
    frames = range(scene.first_frame, scene.last_frame + 1)
    for view in scene.views:
        for camera, files in truth_files(scene, view).items():
            where = f"scene {scene.name}, view {view.name}: truth of {camera}"
            if view.frames == "all":
                _require_shown(scene, view, files, where)
            if scene.kind != KITTI360:
                continue  # images of any size and file type: the stage `scene_metrics` compares sizes
            paths = [layout.image_path(camera, frame) for frame in frames]
            recorded = next((path for path in paths if path.is_file()), None)
            if recorded is None:
                raise DataError(
                    f"{where}: expected recorded images of that camera in {paths[0].parent}, found none; "
                    "nothing of it can be rendered: name another camera"
                )
            size = _png_size(recorded)
            for path in files.values():
                own = _png_size(path)
                if size is not None and own != size:
                    raise DataError(
                        f"{where}: expected {size[0]} x {size[1]} pixels as in {recorded.name}, found "
                        f"{'no PNG' if own is None else f'{own[0]} x {own[1]}'} in {path}; rectify or cut it "
                        "as the camera's recorded images are"
                    )


def _require_shown(scene: SceneEntry, view: ViewEntry, true_frames: Iterable[int], where: str) -> None:
    """Refuse true images of frames of which the view has no image: its path may end before, or lack poses."""
    try:
        shown = asked_frames(view, drive_of(scene)).tolist()
    except (DataError, OSError):
        return  # `require_views`, or the stage `frames`, says what is wrong
    true_frames = sorted(true_frames)
    if not set(shown) & set(true_frames):
        raise DataError(
            f"{where}: expected images of some of the view's frames, {shown[0]} to {shown[-1]}, found those "
            f"of {true_frames!s:.100}; add images of its frames, or leave `truth` out"
        )


def _png_size(path: Path) -> tuple[int, int] | None:
    """Columns and rows that a PNG's header claims; None for other files, of which a stage says more."""
    with path.open("rb") as file:
        head = file.read(_PNG_HEADER_BYTES)
    if len(head) < _PNG_HEADER_BYTES or not head.startswith(b"\x89PNG"):
        return None
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
