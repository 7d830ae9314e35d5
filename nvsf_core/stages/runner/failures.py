"""What a scene's stages failed with last: a document a stage, kept until that stage succeeds.

A later run may be over other scenes, or only make the report: what failed before must still be said.
"""

import contextlib
import time
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

from nvsf_core.errors import StoreError
from nvsf_core.names import RESERVED_SCENES, name_fault
from nvsf_core.stores.documents import read_document, write_document
from nvsf_core.stores.scene_store import SceneStore, published

_FOLDER = ".failed"
"""Folder in the scene's; hidden, for it is no output."""


def remember_failure(store: SceneStore, stage: str, words: str) -> None:
    """Write down why a stage failed; a disk that refuses must not hide the failure itself.

    `stage` is its name, or the place of the output of one that is run per recipe, as `field/lean/0`.
    """
    with contextlib.suppress(OSError, StoreError):
        folder = store.path(_FOLDER)
        folder.mkdir(parents=True, exist_ok=True)
        write_document(folder / _name(stage), {"words": words, "failed_s": time.time()})


def forget_failure(store: SceneStore, stage: str) -> None:
    """Remove what `remember_failure` wrote: the stage has succeeded."""
    with contextlib.suppress(OSError, StoreError):
        (store.path(_FOLDER) / _name(stage)).unlink(missing_ok=True)


def _name(stage: str) -> str:
    return f"{stage.replace('/', ' ')}.json"


def remembered_failures(home: Path, stages: Iterable[str]) -> dict[str, str]:
    """Scene to the failures of its stages since they last succeeded, in words; by name."""
    order = {name: rank for rank, name in enumerate(stages)}
    found: dict[str, str] = {}
    scenes = sorted(home.iterdir()) if home.is_dir() else []
    for scene in scenes:
        if name_fault(scene.name, RESERVED_SCENES) is not None or scene.is_symlink():
            continue
        paths = published(scene, f"{_FOLDER}/*.json")
        paths.sort(key=lambda path: (order.get(path.stem.partition(" ")[0], len(order)), path.stem))
        if paths:
            found[scene.name] = "\n".join(_in_words(path) for path in paths)
    return found


def _in_words(path: Path) -> str:
    """`<stage>: <error> (<when>)`, and what to remove where that is settled otherwise."""
    try:
        said = read_document(path)
        when = datetime.fromtimestamp(float(said["failed_s"]), UTC)
        return f"{path.stem}: {said['words']!s} ({when:%Y-%m-%d %H:%M} UTC; if it is settled, remove {path})"
    except (StoreError, TypeError, ValueError, OverflowError, OSError):
        return f"{path.stem}: failed; why cannot be read from {path}"
