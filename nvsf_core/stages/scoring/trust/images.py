"""Cues on a view's images that need no truth, with the band of recorded held-out images.

A held-out image is carried back into the training images with the depths that were rendered for its place:
the band is what recorded images have among themselves through the same geometry.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.metrics.trust.cues import DISAGREES, GUESSED, IMAGE_PATCHES, PARALLAX
from nvsf_core.metrics.trust.likeness_classifier import distinguished, image_features
from nvsf_core.metrics.trust.photo_consistency import (
    LookBack,
    ParallaxCurve,
    expected_difference,
    fill_difference,
    look_back,
    nearest_difference,
    parallax_curve,
)
from nvsf_core.recording.images import CameraImages
from nvsf_core.rendering.rendered import Support
from nvsf_core.stages.checks.norms import training_frames
from nvsf_core.stages.inputs import pinhole_of
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stores.arrays import holds_array, read_arrays, read_attrs

_NEIGHBOURS = 2


@dataclass(frozen=True, slots=True, eq=False)
class _HeldOut:
    """Held-out images of a camera, carried back through the depths rendered there."""

    frame: list[int]
    looks: list[LookBack]
    guessed: list[np.ndarray]
    fills: list[float]

    def curve(self, leave_out: int | None = None) -> ParallaxCurve | None:
        """The curve of all held-out images but that of a frame; None if none is left."""
        kept = [k for k, frame in enumerate(self.frame) if frame != leave_out]
        return parallax_curve([self.looks[k] for k in kept], [self.fills[k] for k in kept])


class RecordedCamera:
    """The training images of one camera, and what recorded images have among themselves."""

    def __init__(self, task: Task, camera: str, held_out: Path | None) -> None:
        """Read a camera's recorded images, and the depths of held-out frames from the group `held_out`."""
        folder = task.store.require("undistorted") / "images.zarr"
        a = read_arrays(
            folder, *(f"{camera}_{part}" for part in ("rgb", "valid", "frame", "camera_to_world"))
        )
        self.name, self.frame = camera, a[f"{camera}_frame"]
        self.valid: np.ndarray = a[f"{camera}_valid"]
        self._rgb = a[f"{camera}_rgb"]
        self.training = np.flatnonzero(np.isin(self.frame, training_frames(task.store)))
        self.images = CameraImages(
            pinhole_of(read_attrs(folder)["cameras"][camera]), self._rgb[self.training],
            a[f"{camera}_camera_to_world"][self.training], np.flatnonzero(self.valid.reshape(-1)),
        )  # fmt: skip
        self.patches = [image_features(rgb, self.valid) for rgb in self.images.rgb]
        self._held_out = self._carried_back(held_out)

    def curve(self, leave_out: int | None = None) -> ParallaxCurve | None:
        """How far recorded images differ by parallax; without the image of a held-out frame."""
        return self._held_out.curve(leave_out)

    def band(self) -> list[dict[str, float]]:
        """Cues of recorded images: of the held-out ones by their depths, of the training ones by patches.

        A single held-out image has none by its depths: compared with itself, it would be as recorded always.
        """
        one, found = self._held_out, list[dict[str, float]]()
        for frame, look, guessed in zip(one.frame, one.looks, one.guessed, strict=True):
            curve = one.curve(frame)
            if curve is not None:
                found.append(_differences(look, guessed, curve))
        for k, patches in enumerate(self.patches):
            others = self._neighbours(float(self.frame[self.training[k]]), leave_out=k)
            if others is not None:
                found.append({IMAGE_PATCHES.name: distinguished(patches, others)})
        return found

    def cues(
        self, image: Mapping[str, np.ndarray], frame: int, curve: ParallaxCurve | None
    ) -> dict[str, float]:
        """Cues of a rendered image, by the parts of `_view_arrays`."""
        guessed, found = _is_guessed(image), dict[str, float]()
        if "support" in image:
            found[GUESSED] = float(np.mean(guessed[self.valid]))
        others = self._neighbours(float(frame))
        if others is not None:
            found[IMAGE_PATCHES.name] = distinguished(image_features(image["rgb"], self.valid), others)
        if curve is not None:
            look = look_back(image["rgb"], image["range_m"], image["camera_to_world"], self.images)
            found |= _differences(look, guessed, curve)
        return found

    def _neighbours(self, frame: float, *, leave_out: int | None = None) -> np.ndarray | None:
        """Features of the training images nearest in time."""
        away = np.abs(self.frame[self.training] - frame)
        order = [k for k in np.argsort(away, kind="stable").tolist() if k != leave_out][:_NEIGHBOURS]
        return np.concatenate([self.patches[k] for k in order]) if order else None

    def _carried_back(self, path: Path | None) -> _HeldOut:
        found = _HeldOut([], [], [], [])
        if path is None:
            return found
        a = _view_arrays(path, self.name)
        for i, frame in enumerate(a["frame"].tolist()):
            for k in np.flatnonzero(self.frame == frame)[:1].tolist():
                look = look_back(self._rgb[k], a["range_m"][i], a["camera_to_world"][i], self.images)
                found.frame.append(frame)
                found.looks.append(look)
                found.guessed.append(_is_guessed({name: values[i] for name, values in a.items()}))
                found.fills.append(fill_difference(self._rgb[k], self.valid))
        return found


def image_cues(path: Path, camera: RecordedCamera) -> Iterator[tuple[int, Mapping[str, float]]]:
    """Cues of each image of a camera in a stored view of the model: its frame, and cue to value.

    Of a view of held-out frames no image measures itself.
    """
    a = _view_arrays(path, camera.name)
    for i, frame in enumerate(a["frame"].tolist()):
        curve = camera.curve(frame if path.parent.name == HELD_OUT else None)
        yield frame, camera.cues({name: values[i] for name, values in a.items()}, frame, curve)


def _view_arrays(path: Path, camera: str) -> dict[str, np.ndarray]:
    """Arrays of a camera's images in a view, `support` where it is stored; empty without depths."""
    parts = ["rgb", "range_m", "frame", "camera_to_world"]
    if not holds_array(path, f"{camera}_range_m"):
        return {"frame": np.zeros(0, np.int64)}
    if holds_array(path, f"{camera}_support"):
        parts.append("support")
    a = read_arrays(path, *(f"{camera}_{part}" for part in parts))
    return {part: a[f"{camera}_{part}"] for part in parts}


def _is_guessed(image: Mapping[str, np.ndarray]) -> np.ndarray:
    """(H, W) bool: guessed pixels; none of an image whose support is not known."""
    if "support" not in image:
        return np.zeros(image["range_m"].shape, np.bool_)
    return np.asarray(image["support"] == Support.GUESSED)


def _differences(look: LookBack, guessed: np.ndarray, curve: ParallaxCurve) -> dict[str, float]:
    """Root mean squared differences, 0..1: measured, and expected."""
    measured = nearest_difference(look)
    measured = np.where(np.isfinite(measured), measured, curve.fill)
    return {
        DISAGREES.name: float(np.sqrt(measured.mean())),
        PARALLAX.name: float(np.sqrt(expected_difference(look, guessed, curve).mean())),
    }
