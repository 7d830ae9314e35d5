"""Check of cameras' mountings: where one is right, what scans measured looks alike in two images."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter

from nvsf_core.drives.drive import drive_of
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import poses_in
from nvsf_core.stages.checks.declared import MOST_UNLIKE, MOUNTING_CHECK
from nvsf_core.stages.checks.registration import thinned_scan
from nvsf_core.stages.runner.stage import Check, Task
from nvsf_core.stages.undistorted import camera_of
from nvsf_core.stores.documents import read_document
from nvsf_core.stores.tables import read_rows

_LEAST_APART_M = 1.5
"""Images nearer to each other look alike by any mounting."""
_MOST_PAIRS = 6
_FEWEST_PAIRS, _FEWEST_POINTS = 3, 50
_BLUR_PX = 9
"""Asphalt and leaves are as noise to points that are some pixels off."""
_BY_CHANCE = 0.4
"""Likeness that a wrong mounting reaches easily, 0.3 to 0.6 in streets: a camera that sees no point is
not below it."""
_LEAST_UNLIKE = 0.1
"""Images of one place are as unlike for other reasons; on bare ground wrong mountings come down to 0.05."""
_TURNED = np.diag([-1.0, -1.0, 1.0, 1.0])
_FROM_OPTICAL = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""From a camera's axes (x right, y down, z forward) to x forward, y left, z up."""
_READINGS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "the pose is inverted: write the camera's in the LiDAR's frame": np.linalg.inv,
    "the pose is turned by 180 degrees about the LiDAR's z": lambda mounting: _TURNED @ mounting,
    "the pose is turned by 180 degrees about the optical axis": lambda mounting: mounting @ _TURNED,
    "the pose is that of axes x forward, y left, z up: write that of x right, y down, z forward": (
        lambda mounting: mounting @ _FROM_OPTICAL
    ),
}


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Two images of one camera, and points that a scan measured at the first."""

    points_m: np.ndarray
    """(N, 3) scene-local, metres."""
    images: tuple[np.ndarray, np.ndarray]
    """(H, W) float32 grey values, blurred; NaN where the image shows nothing."""
    lidar_to_scene: tuple[np.ndarray, np.ndarray]
    """(4, 4) poses at the images' times."""


def mountings_check(task: Task, arrays: Mapping[str, np.ndarray], scene_to_world: np.ndarray) -> Check:
    """Check that no other reading of a camera's mounting fits its images much better.

    Args:
        task: Of the stage `sweeps`; its drive's images are read.
        arrays: Arrays of `sweeps/returns.zarr`.
        scene_to_world: (4, 4) pose of the scene's frame in the drive's own world.
    """
    frames = task.store.require("frames")
    facts: dict[str, Any] = read_document(frames / "drive.json")
    rows = [row for row in read_rows(frames / "cameras.parquet") if row["image_valid"]]
    rows = [row for row in rows if len(row["camera_to_world"] or ()) == 16]
    unlike, words = {}, []
    for camera in sorted(facts["cameras"]):
        own = sorted((row for row in rows if row["camera"] == camera), key=lambda row: int(row["frame"]))
        view, pairs = _pairs(task, camera, facts, own, arrays, scene_to_world)
        mounting = np.array(facts["camera_in_lidar"][camera], np.float64).reshape(4, 4)
        given = _likeness(view, pairs, mounting)
        others = {name: _likeness(view, pairs, read(mounting)) for name, read in _READINGS.items()}
        best = max(others, key=lambda name: others[name])
        if max(given, others[best]) == 0.0:
            continue
        unlike[camera] = (1.0 - max(given, _BY_CHANCE)) / max(1.0 - others[best], _LEAST_UNLIKE)
        if unlike[camera] > MOST_UNLIKE:
            words.append(f"{camera}: {best} (images agree by {others[best]:.2f}; as given, by {given:.2f})")
    if not unlike:
        return MOUNTING_CHECK.not_run("no camera sees enough of a scan's points from places apart")
    detail = f"of {len(unlike)} cameras {len(words)} are mounted otherwise"
    return MOUNTING_CHECK.outcome(max(unlike.values()), MOST_UNLIKE, "; ".join([detail, *words]))


# Wide: a camera's images, what they are called by, and what they are compared with.
def _pairs(
    task: Task,
    camera: str,
    facts: Mapping[str, Any],
    rows: Sequence[Mapping[str, Any]],
    arrays: Mapping[str, np.ndarray],
    scene_to_world: np.ndarray,
) -> tuple[Pinhole, list[_Pair]]:
    """A camera's view, and pairs of its images, evenly chosen.

    Args:
        task: Of the stage `sweeps`.
        camera: Its name.
        facts: Of the stage `frames`.
        rows: Of the camera's images, by frame.
        arrays: Arrays of `sweeps/returns.zarr`.
        scene_to_world: (4, 4) pose of the scene's frame in the drive's own world.
    """
    undistorter, view = camera_of(camera, facts["cameras"][camera])
    size_px = int(facts["cameras"][camera]["width"]), int(facts["cameras"][camera]["height"])
    from_camera = np.linalg.inv(np.array(facts["camera_in_lidar"][camera], np.float64).reshape(4, 4))
    to_world = np.array([row["camera_to_world"] for row in rows], np.float64).reshape(-1, 4, 4)
    lidar_to_scene = poses_in(scene_to_world, to_world) @ from_camera
    drive, images = drive_of(task.scene), {}

    def image(k: int) -> np.ndarray:
        if k not in images:
            pixels = drive.read_image(camera, int(rows[k]["frame"]), *size_px, rows[k]["checksum"] or "")
            grey = (pixels if undistorter is None else undistorter.apply(pixels)).mean(axis=-1)
            images[k] = uniform_filter(grey.astype(np.float32), _BLUR_PX)
            if undistorter is not None:
                images[k][~undistorter.valid] = np.nan
        return images[k]

    scan_of = {frame: scan for scan, frame in enumerate(arrays["frame"].tolist())}
    found = []
    for first, second in _apart(lidar_to_scene[:, :3, 3], [row["frame"] in scan_of for row in rows]):
        points_m = thinned_scan(arrays, scan_of[rows[first]["frame"]])
        both = (lidar_to_scene[first], lidar_to_scene[second])
        found.append(_Pair(points_m, (image(first), image(second)), both))
    return view, found


def _apart(places_m: np.ndarray, is_scanned: Sequence[bool]) -> list[tuple[int, int]]:
    """Images with a scan, evenly chosen, each with the next, else the last before, that is apart from it."""
    scanned = np.flatnonzero(is_scanned)
    chosen = scanned[np.unique(np.linspace(0, len(scanned) - 1, min(_MOST_PAIRS, len(scanned))).astype(int))]
    found = []
    for k in chosen.tolist():
        far = np.flatnonzero(np.linalg.norm(places_m - places_m[k], axis=1) >= _LEAST_APART_M)
        later = far[far > k]
        if len(far):
            found.append((k, int(later[0] if len(later) else far[-1])))
    return found


def _likeness(view: Pinhole, pairs: Sequence[_Pair], mounting: np.ndarray) -> float:
    """Mean correlation of the grey values at points that both images of a pair see; 0 where too few do.

    Args:
        view: The camera.
        pairs: Pairs of its images.
        mounting: (4, 4) camera to LiDAR.
    """
    found = []
    for pair in pairs:
        seen = np.ones(len(pair.points_m), np.bool_)
        values = []
        for image, pose in zip(pair.images, pair.lidar_to_scene, strict=True):
            to_camera = np.linalg.inv(pose @ mounting)
            pixels, is_inside = view.project(pair.points_m @ to_camera[:3, :3].T + to_camera[:3, 3])
            column, row = np.rint(np.where(is_inside[:, None], pixels, 0.0)).astype(np.int64).T
            values.append(image[row, column])
            seen &= is_inside & np.isfinite(values[-1])
        grey = [one[seen] for one in values]
        if np.count_nonzero(seen) >= _FEWEST_POINTS and min(one.std() for one in grey) > 0.0:
            found.append(float(np.corrcoef(*grey)[0, 1]))
    return max(0.0, float(np.mean(found))) if len(found) >= _FEWEST_PAIRS else 0.0
