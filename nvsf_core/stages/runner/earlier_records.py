"""Outputs recorded by NVSF 0.1 before fingerprints were of content: recognised, so that none is made again.

Their fingerprint was of the drive's place and of the names, sizes and times of its files. While these are
unchanged it can be computed again, and the output is taken over. For a home that was moved since,
NVSF_EARLIER_HOME names where it lay.
"""

import hashlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.drives.view_truth import truth_files
from nvsf_core.stages.runner.stage import RunConfig, Stage
from nvsf_core.stores.checksums import json_digest

EARLIER = "earlier"
"""Key of a record: the fingerprint that the output had before, which those of its readers were made with."""
_SCENE_KEYS = (
    "name", "root", "sequence", "first_frame", "last_frame", "test_frames", "sweep_period_s", "cameras",
)  # fmt: skip
_VIEW_KEYS = ("name", "scenes", "sensor", "shift_m", "yaw_deg", "frames", "times_s", "exports", "truth")


def is_earlier(record: Mapping[str, Any]) -> bool:
    """Whether a record was written before fingerprints were of content."""
    return "facts" not in record


def earlier_fingerprint(record: Mapping[str, Any]) -> str | None:
    """The fingerprint that an output had before; None if it was first made since."""
    found = record["fingerprint"] if is_earlier(record) else record.get(EARLIER)
    return found if isinstance(found, str) else None


def is_taken_over(
    record: Mapping[str, Any],
    stage: Stage,
    scene: SceneEntry,
    config: RunConfig,
    inputs: Mapping[str, str | None],
    homes: tuple[Path, Path | None],
) -> bool:
    """Whether an earlier record's output is up to date by the rule that it was made with.

    Args:
        record: The record.
        stage: Its stage.
        scene: The scene.
        config: Recipe and seeds.
        inputs: Name of each input to the fingerprint that it had before.
        homes: The home, and the place where it lay before, if it was moved.
    """
    known = {name: one for name, one in inputs.items() if one is not None}
    if len(known) < len(stage.inputs):
        return False
    for placed in _placed(scene, *homes):
        if json_digest(_facts(stage, placed, scene, config, known)) == record["fingerprint"]:
            return True
    return False


def _placed(scene: SceneEntry, home: Path, earlier_home: Path | None) -> Iterator[SceneEntry]:
    """The scene as its entry is, and as it was in the home's earlier place."""
    yield scene
    if earlier_home is None:
        return

    def before(path: Path) -> Path:
        return earlier_home / path.relative_to(home) if path.is_relative_to(home) else path

    views = tuple(
        replace(view, truth=tuple((camera, before(folder)) for camera, folder in view.truth))
        for view in scene.views
    )
    yield replace(scene, root=before(scene.root), views=views)


def _facts(
    stage: Stage, placed: SceneEntry, scene: SceneEntry, config: RunConfig, inputs: Mapping[str, str]
) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "stage": stage.name,
        "version": stage.version,
        "inputs": {name: inputs[name] for name in sorted(stage.inputs)},
        "scene": {key: str(getattr(placed, key)) for key in _SCENE_KEYS}
        | {"compensate": str(placed.is_to_compensate)},
    }
    if stage.per_recipe:
        facts |= {"recipe": config.recipe.identity(), "seed": config.seed}
    if stage.per_draw:
        facts["draw"] = [config.draw_seed, config.dataset_label]
    if stage.reads_views:
        facts["views"] = [str({key: getattr(view, key) for key in _VIEW_KEYS}) for view in placed.views]
    if stage.reads_drive:
        facts["drive"] = _drive_listing(scene)
    if stage.reads_truth:
        facts["truth"] = _truth_listing(scene)
    return facts


def _drive_listing(scene: SceneEntry) -> str:
    digest = hashlib.sha256()
    folders = [scene.root / "calibration"] + [
        scene.root / kind / scene.sequence for kind in ("data_3d_raw", "data_2d_raw", "data_poses")
    ]
    files = [path for folder in folders for path in _files_below(folder)]
    files += sorted((scene.root / "data_3d_bboxes").glob(f"*/{scene.sequence}.xml"))
    for path in files:
        if path.is_file():
            digest.update(_line(path, path.relative_to(scene.root).as_posix()))
    return digest.hexdigest()


def _truth_listing(scene: SceneEntry) -> str:
    digest = hashlib.sha256()
    for view in scene.views:
        for camera, files in truth_files(scene, view).items():
            for path in files.values():
                digest.update(_line(path, f"{view.name} {camera} {path.name}"))
    return digest.hexdigest()


def _line(path: Path, name: str) -> bytes:
    found = path.stat()
    return os.fsencode(f"{name} {found.st_size} {found.st_mtime_ns}\n")


def _files_below(folder: Path) -> list[Path]:
    return sorted(Path(place) / name for place, _, names in os.walk(folder) for name in names)
