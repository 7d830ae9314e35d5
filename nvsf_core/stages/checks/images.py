"""Checks of stored rendered images: none is blank, and greys are like the training images'."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nvsf_core.metrics.norms import ImageNorms, image_norms
from nvsf_core.stages.checks.declared import BLANK, GREYS
from nvsf_core.stages.checks.norms import training_frames
from nvsf_core.stages.runner.stage import Check, Task
from nvsf_core.stores.arrays import holds_array, read_arrays, read_attrs

_MODEL = "model"
_NAMED = 3


@dataclass(frozen=True, slots=True)
class _Image:
    """Grey values of one rendered image, and their limits."""

    place: str
    deviation: float
    """Standard deviation of the grey values, levels of 255."""
    blank_below: float
    recorded_deviation: float
    """That of its camera's plainest training image."""
    has_depth: bool
    apart: float
    apart_limit: float

    def in_words(self) -> str:
        """Its place, its deviation and limit, and whether depth is missing, or its camera saw little, too."""
        depth = "" if self.has_depth else ", no pixel has a finite depth"
        dark = (
            f", but the recording is as dark or plain, from {self.recorded_deviation:.1f} levels"
            if self.recorded_deviation < self.blank_below
            else ""
        )
        return f"{self.place}: {self.deviation:.1f} levels, blank below {self.blank_below:.1f}{dark}{depth}"


def check_images(task: Task) -> list[Check]:
    """Check the model's images of all views in the task's folder.

    Returns:
        One outcome per check of `BLANK` and `GREYS`.
    """
    images = list(_images(task))
    if not images:
        reason = "no rendered image with training images of its camera"
        return [named.not_run(reason) for named in (BLANK, GREYS)]
    blank = [image for image in images if image.deviation < image.blank_below or not image.has_depth]
    named = blank[:_NAMED] or [min(images, key=lambda image: image.deviation / image.blank_below)]
    words = "; ".join(image.in_words() for image in named)
    found = f"{len(blank)} of {len(images)} images are blank; {'' if blank else 'plainest '}{words}"
    worst = max(images, key=lambda image: image.apart / image.apart_limit)
    beyond = sum(image.apart > image.apart_limit for image in images)
    far = (
        f"worst greys {worst.apart:.3f} apart, limit {worst.apart_limit:.3f} ({worst.place}); "
        f"{beyond} of {len(images)} images beyond theirs"
    )
    return [
        BLANK.outcome(len(blank) / len(images), 0.0, found),
        GREYS.outcome(worst.apart / worst.apart_limit, 1.0, far),
    ]


def _images(task: Task) -> Iterator[_Image]:
    paths = sorted(task.folder.glob(f"*/{_MODEL}.zarr"))
    views = [(path, read_attrs(path).get("cameras", ())) for path in paths]
    recorded = read_attrs(task.store.require("undistorted") / "images.zarr").get("cameras", {})
    # Cameras of other intrinsics have no recorded images to be like.
    for camera in sorted({camera for _, cameras in views for camera in cameras if camera in recorded}):
        norms = _norms(task, camera)
        if norms is None:
            continue
        for path, cameras in views:
            if camera in cameras:
                yield from _of_view(path, camera, norms)


def _norms(task: Task, camera: str) -> ImageNorms | None:
    """Grey value statistics of a camera's training images; None if it has none."""
    path = task.store.require("undistorted") / "images.zarr"
    a = read_arrays(path, f"{camera}_rgb", f"{camera}_valid", f"{camera}_frame")
    own = a[f"{camera}_rgb"][np.isin(a[f"{camera}_frame"], training_frames(task.store))]
    return image_norms(own, a[f"{camera}_valid"]) if len(own) else None


def _of_view(path: Path, camera: str, norms: ImageNorms) -> Iterator[_Image]:
    a = read_arrays(path, f"{camera}_rgb", f"{camera}_frame")
    depth = f"{camera}_range_m"
    range_m = read_arrays(path, depth)[depth] if holds_array(path, depth) else None
    blank_below, apart_limit = norms.blank_below, norms.greys_limit
    for i, (image, frame) in enumerate(zip(a[f"{camera}_rgb"], a[f"{camera}_frame"], strict=True)):
        yield _Image(
            place=f"view {path.parent.name}, {camera}, frame {frame}",
            deviation=norms.deviation_of(image),
            blank_below=blank_below,
            recorded_deviation=float(norms.deviation.min()),
            has_depth=range_m is None or bool(np.isfinite(range_m[i][norms.seen]).any()),
            apart=norms.greys_apart(image),
            apart_limit=apart_limit,
        )
