"""Plan of a curve: the scene, its training frames, and where the result is stored."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.common.documents import RESULTS_DIR, write_whole
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.errors import DataError
from nvsf_core.stores.scene_store import SceneStore

RESULTS = RESULTS_DIR / "curves"
MARKS_S = (5.0, 15.0, 30.0, 60.0, 120.0, 300.0, 600.0)
"""Seconds of training at which errors are logged; the end is always."""
FULL, VAL = "full", "val"
_VAL_EVERY = 7
_SPLIT = re.compile(r"(full|val)|(every|frames|images)([1-9]\d*)")


class OneRun(NamedTuple):
    """What one training measures; a baseline is a recipe too."""

    scene: str
    split: str
    recipe: str
    seed: int

    def path(self, results: Path) -> Path:
        """Where it leaves its JSON."""
        return results / self.scene / self.split / f"{self.recipe}-{self.seed}.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Split:
    """Which frames of a scene are trained and which are scored."""

    name: str
    entry: SceneEntry
    """The scene with every frame held out that is not trained."""
    scored: tuple[int, ...]
    """Frames that are compared with what was recorded; never trained."""
    image_divisor: int = 1
    """Images are so many times smaller a side."""

    @property
    def trained(self) -> tuple[int, ...]:
        """Frames that are trained."""
        return _training_frames(self.entry)

    def store(self, home: Path) -> SceneStore:
        """Its stages' outputs; those of a part of a scene lie apart from the scenes."""
        if self.name == FULL:
            return SceneStore(home=home, scene=self.entry.name)
        return SceneStore(home=home / ".curves", scene=f"{self.entry.name}-{self.name}")


def split_of(scene: SceneEntry, name: str) -> Split:
    """A split by name.

    `full`: the catalogue's. `everyN`: every N-th training frame is trained, the same frames are scored.
    `val`: every 7th training frame is left out and scored; the held-out frames are not looked at.
    `framesN`: the section's first N frames. `imagesN`: images N times smaller a side; they are not scored.

    Raises:
        DataError: There is no such split, or the scene has too few frames for it.
    """
    found = _SPLIT.fullmatch(name)
    if found is None:
        raise DataError(f"no split {name!r}; there are full, val, everyN, framesN and imagesN, N a number")
    kind, number, train = found[1] or found[2], int(found[3] or 1), _training_frames(scene)
    if kind == "frames":
        if number > scene.last_frame - scene.first_frame + 1:
            raise DataError(f"split {name}: scene {scene.name} has fewer frames")
        last = scene.first_frame + number - 1
        test = tuple(frame for frame in scene.test_frames if frame <= last)
        return Split(name=name, entry=replace(scene, last_frame=last, test_frames=test), scored=test)
    if kind == VAL:
        left_out = train[_VAL_EVERY // 2 :: _VAL_EVERY]
        return Split(name=name, entry=_held_out(scene, left_out), scored=left_out)
    if kind == "every":
        left_out = tuple(frame for index, frame in enumerate(train) if index % number)
        return Split(name=name, entry=_held_out(scene, left_out), scored=scene.test_frames)
    divisor = number if kind == "images" else 1
    return Split(name=name, entry=scene, scored=scene.test_frames, image_divisor=divisor)


def read_result(path: Path) -> dict[str, Any] | None:
    """A finished run; None where there is none."""
    return json.loads(path.read_text()) if path.is_file() else None


def write_result(path: Path, facts: dict[str, Any], points: Sequence[dict[str, Any]]) -> None:
    """Write a run, one line a fact and a point."""
    lines = ",\n".join(f"  {json.dumps(point)}" for point in points)
    about = ",\n".join(f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in facts.items())
    write_whole(path, f'{{\n "run": {{\n{about}\n }},\n "points": [\n{lines}\n ]\n}}\n')


def _training_frames(scene: SceneEntry) -> tuple[int, ...]:
    every = range(scene.first_frame, scene.last_frame + 1)
    return tuple(frame for frame in every if frame not in scene.test_frames)


def _held_out(scene: SceneEntry, more: Sequence[int]) -> SceneEntry:
    return replace(scene, test_frames=tuple(sorted({*scene.test_frames, *more})))
