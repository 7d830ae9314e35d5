"""Cameras with the same intrinsics, as of a stereo pair: the images of each are sources for all of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nvsf_core.recording.drive import Recording
from nvsf_core.recording.images import CameraRecording

_LEAST_COSINE = math.cos(math.radians(15.0))
"""Between the axes of cameras that look the same way."""


@dataclass(frozen=True, slots=True)
class SharedImages:
    """The training images of such cameras, numbered camera after camera; most cameras share with none."""

    cameras: tuple[str, ...]
    count: int
    """Training images of each camera, all of the same instants."""

    @property
    def name(self) -> str:
        """Of the first camera: what belongs to all is stored under it."""
        return self.cameras[0]

    def number(self, camera: str, index: int) -> int:
        """Number of a camera's own training image `index`."""
        return self.cameras.index(camera) * self.count + index

    def at_instant_of(self, index: int) -> set[int]:
        """Numbers of the images of the instant of each camera's own training image `index`."""
        return {self.number(camera, index) for camera in self.cameras}

    def of_others(self, camera: str) -> set[int]:
        """Numbers of the images that are not a camera's own."""
        own = self.number(camera, 0)
        return set(range(len(self.cameras) * self.count)) - set(range(own, own + self.count))

    @property
    def instant(self) -> np.ndarray:
        """(n,) int64: number of each image's instant."""
        return np.tile(np.arange(self.count), len(self.cameras))

    def poses(self, recording: Recording) -> np.ndarray:
        """(n, 4, 4) of all images, camera to scene-local."""
        return np.concatenate([recording.cameras[camera].training.pose for camera in self.cameras])

    def off_path_m(self, recording: Recording, place_m: np.ndarray) -> float:
        """Distance, metres, of a place (3,), scene-local, from the paths of the cameras, image to image."""
        paths = self.poses(recording)[:, :3, 3].reshape(len(self.cameras), self.count, 3)
        starts, ends = paths[:, : max(1, self.count - 1)], paths[:, min(1, self.count - 1) :]
        ahead, there = ends - starts, place_m - starts
        length2 = np.maximum((ahead * ahead).sum(axis=2), np.finfo(np.float64).tiny)
        share = np.clip((there * ahead).sum(axis=2) / length2, 0.0, 1.0)
        return float(np.linalg.norm(there - share[..., None] * ahead, axis=2).min())

    def rgb(self, recording: Recording) -> np.ndarray:
        """(n, H, W, 3) uint8 of all images."""
        return np.concatenate([recording.cameras[camera].training.rgb for camera in self.cameras])

    def times_s(self, recording: Recording) -> np.ndarray:
        """(n,) instants of all images."""
        return np.concatenate([recording.cameras[camera].training_time_s for camera in self.cameras])


def shared_images(recording: Recording, cameras: Sequence[str]) -> tuple[SharedImages, ...]:
    """Which of the named cameras share their training images, each named once.

    They do if they look the same way, intrinsics, valid pixels and frames are the same, and all are grey or
    all in colour: KITTI's car carries a grey and a coloured pair with the same intrinsics.
    """
    alike: list[list[str]] = []
    for name in cameras:
        own = recording.cameras[name]
        found = next((one for one in alike if _are_alike(recording.cameras[one[0]], own)), None)
        if found is None:
            alike.append([name])
        else:
            found.append(name)
    return shared_by(recording, alike)


def shared_by(recording: Recording, alike: Sequence[Sequence[str]]) -> tuple[SharedImages, ...]:
    """The training images of cameras of which it is known who shares with whom."""
    return tuple(SharedImages(tuple(names), len(recording.cameras[names[0]].training.rgb)) for names in alike)


def _are_alike(one: CameraRecording, other: CameraRecording) -> bool:
    return (
        one.training.pinhole == other.training.pinhole
        and np.array_equal(one.training.pixel, other.training.pixel)
        and np.array_equal(one.training_frame, other.training_frame)
        and float(one.in_lidar[:3, 2] @ other.in_lidar[:3, 2]) > _LEAST_COSINE
        and _is_grey(one.training.rgb[0]) == _is_grey(other.training.rgb[0])
    )


def _is_grey(rgb: np.ndarray) -> bool:
    """Whether an image (H, W, 3) has no colours."""
    return bool((rgb == rgb[..., :1]).all())
