"""Precision and recall of pixels marked *guessed*: no recorded image should show their surface.

``SCENES=street python -m benchmarks.views.known_pixels`` reads what a run of RECIPE (default: quick) rendered
of the embedded street (`NVSF_HOME`) and prints precision and recall for each view and camera, and for all
together. The truth is the street's exact world: a pixel's surface is shown by a training image of the
camera, or of one that shares its images, if it lies in that image and nothing stands in front of it there.
Pixels of moving things are left out: they are elsewhere in every image. The sky has no surface and no place;
it is taken to be 300 m away, and the last row is of all other pixels.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from benchmarks.common.documents import markdown_table
from nvsf_core.demo.world import DemoWorld
from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import invert_pose, transform_points
from nvsf_core.models.residual.shared_images import shared_images
from nvsf_core.rendering.rendered import Support
from nvsf_core.stages.inputs import pinhole_of, read_recording
from nvsf_core.stages.runner.run import find_scene
from nvsf_core.stores.arrays import holds_array, read_arrays, read_attrs
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows

_FAR_M = 300.0
"""Where the sky is taken to be."""
_MARGIN_SHARE, _MARGIN_M = 0.02, 0.2
"""A surface that is nearer by more hides what is behind it."""


@dataclass(frozen=True)
class TrueCamera:
    """The training images of a camera, and those that are shared with it, in the exact world."""

    world: DemoWorld
    pinhole: Pinhole
    poses: np.ndarray
    """(j, 4, 4) camera to world."""
    time_s: np.ndarray
    """(j,) seconds of the world."""

    @cached_property
    def depths(self) -> list[np.ndarray]:
        """Exact depth (H, W) along z of each image, metres."""
        return [self.surface(*one)[0][..., 2] for one in zip(self.poses, self.time_s.tolist(), strict=True)]

    def surface(self, pose: np.ndarray, time_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First surface of each pixel, camera frame (H, W, 3), m; whether it moves, is sky (H, W) bool."""
        rays = self.pinhole.rays(self.pinhole.pixels())
        directions = (rays.reshape(-1, 3) @ pose[:3, :3].T).astype(np.float32)
        origins = np.broadcast_to(pose[:3, 3], directions.shape)
        hits = self.world.cast(origins, directions, np.full(len(directions), time_s))
        shape, is_sky = rays.shape[:2], ~(hits.range_m < _FAR_M)
        range_m = np.minimum(hits.range_m, _FAR_M).reshape(shape)
        moving = np.isin(hits.instance, [mover.object_id for mover in self.world.street.movers])
        return rays * range_m[..., None], moving.reshape(shape), is_sky.reshape(shape)

    def shows(self, points_m: np.ndarray) -> np.ndarray:
        """(H, W) bool: points (H, W, 3) of the world, metres, that some training image shows."""
        shown = np.zeros(points_m.shape[:2], np.bool_)
        for pose, depth_m in zip(self.poses, self.depths, strict=True):
            local = transform_points(invert_pose(pose), points_m.reshape(-1, 3)).reshape(points_m.shape)
            z_m = np.maximum(local[..., 2], 1e-3)
            column = np.round(self.pinhole.fx * local[..., 0] / z_m + self.pinhole.cx).astype(np.int64)
            row = np.round(self.pinhole.fy * local[..., 1] / z_m + self.pinhole.cy).astype(np.int64)
            inside = (local[..., 2] > 0.1) & (column >= 0) & (column < self.pinhole.width)
            inside &= (row >= 0) & (row < self.pinhole.height)
            front = depth_m[row.clip(0, self.pinhole.height - 1), column.clip(0, self.pinhole.width - 1)]
            shown |= inside & (local[..., 2] <= front * (1.0 + _MARGIN_SHARE) + _MARGIN_M)
        return shown


def main() -> None:
    """Print the table."""
    home, recipe = home_from_environment(os.environ), os.environ.get("RECIPE") or "quick"
    scene = find_scene(os.environ.get("SCENES") or "street")
    store, rows = SceneStore(home=home, scene=scene.name), []
    totals = np.zeros((2, 3), np.int64)
    # The exact depths of a camera's training images take minutes, once.
    true: dict[str, TrueCamera] = {}
    for view in scene.views:
        path = store.path(f"novel_views/{recipe}/0/{view.name}/model.zarr")
        for camera in read_attrs(path).get("cameras", []) if path.is_dir() else ():
            if camera not in true:
                true[camera] = _true_camera(store, camera)
            found = sum(_counts(store, path, camera, true[camera]), np.zeros((2, 3), np.int64))
            totals += found
            rows.append((view.name, camera, *_quality(found[0])))
    rows.append(("all", "", *_quality(totals[0])))
    rows.append(("all without the sky", "", *_quality(totals[1])))
    print(markdown_table(("view", "camera", "unseen pixels", "precision", "recall"), rows))


def _counts(store: SceneStore, path: Path, camera: str, one: TrueCamera) -> Iterator[np.ndarray]:
    """Of each image, with the sky and without, the pixels guessed and unseen, guessed, unseen: (2, 3)."""
    if not holds_array(path, f"{camera}_support"):
        return
    a = read_arrays(path, f"{camera}_support", f"{camera}_camera_to_world", "time_s")
    valid = read_arrays(store.require("undistorted") / "images.zarr", f"{camera}_valid")[f"{camera}_valid"]
    for support, pose, time_s in zip(
        a[f"{camera}_support"], a[f"{camera}_camera_to_world"], a["time_s"].tolist(), strict=True
    ):
        surface, moving, is_sky = one.surface(pose, time_s)
        unseen = ~one.shows(transform_points(pose, surface.reshape(-1, 3)).reshape(surface.shape))
        guessed = support == Support.GUESSED
        asked = np.stack([guessed & unseen, guessed, unseen]) & valid & ~moving
        yield np.stack([asked.sum(axis=(1, 2)), (asked & ~is_sky).sum(axis=(1, 2))])


def _true_camera(store: SceneStore, camera: str) -> TrueCamera:
    recording = read_recording(store)
    (shared,) = (one for one in shared_images(recording, list(recording.cameras)) if camera in one.cameras)
    folder, poses = store.require("undistorted") / "images.zarr", []
    frames = {row["frame"]: row for row in read_rows(store.require("frames") / "frames.parquet")}
    for name in shared.cameras:
        a = read_arrays(folder, f"{name}_frame", f"{name}_camera_to_world")
        used = [frames[frame]["split"] == "train" for frame in a[f"{name}_frame"].tolist()]
        poses.append(a[f"{name}_camera_to_world"][used])
    pinhole = pinhole_of(read_attrs(folder)["cameras"][camera])
    return TrueCamera(DemoWorld(), pinhole, np.concatenate(poses), shared.times_s(recording))


def _quality(counts: np.ndarray) -> tuple[str, str, str]:
    """Number of unseen pixels, precision and recall."""
    both, guessed, unseen = counts.tolist()
    return f"{unseen:,}", f"{both / guessed:.3f}" if guessed else "", f"{both / unseen:.3f}" if unseen else ""


if __name__ == "__main__":
    main()
