"""What must be true after each event: nothing is lost, half-written or held, and the next run goes on."""

import fcntl
import hashlib
from collections.abc import Iterator
from pathlib import Path

from benchmarks.chaos.world import LONGEST_RUN_S, SCENE, World
from nvsf_core.stages.runner.verify import Verdict, verify_scene
from nvsf_core.stages.versions import VERSIONS, damage_of_version, versions_of
from nvsf_core.stores.removal import removals
from nvsf_core.stores.scene_store import published

Ledger = dict[str, str]
"""Each file of all data sets that were ever published, below the home, to its SHA-256."""
_HALF = (".publishing-*", ".retired-*", ".removing-*")


def ledger_of(world: World) -> Ledger:
    """What is published now."""
    files = (path for path in published(world.plan().store.root, "dataset/*/*/**/*") if path.is_file())
    return {path.relative_to(world.home).as_posix(): _sha256(path) for path in files}


def losses(world: World, before: Ledger) -> list[str]:
    """Files of earlier versions that are gone or changed, but for versions that are noted as removed."""
    store, now = world.plan().store, ledger_of(world)
    noted = tuple(f"{SCENE}/{one.place}/" for one in removals(store, f"{VERSIONS}/*/*"))
    return [
        f"{name} {'changed' if name in now else 'is gone'}"
        for name, digest in before.items()
        if now.get(name) != digest and "/.index/" not in name and not name.startswith(noted)
    ]


def next_run(world: World) -> Iterator[str]:
    """Run again, undisturbed; what is wrong with it."""
    run = world.start()
    code = run.wait(LONGEST_RUN_S)
    if code != 0:
        yield f"the next run ended with {code}: {run.said[-600:]}"


def left_behind(world: World) -> Iterator[str]:
    """What an undisturbed run should have found and mended, and has not."""
    root = world.plan().store.root
    for pattern in _HALF:
        yield from (f"half-written: {path.relative_to(world.home)}" for path in root.rglob(pattern))
    for found in verify_scene(world.plan(), world.stages):
        if found.verdict is not Verdict.UP_TO_DATE:
            yield f"{found.stage}: {found.verdict.value} {found.words}"
    for version in versions_of(world.plan().store):
        damage = damage_of_version(version)
        if damage is not None:
            yield f"{damage} is damaged"
    yield from (f"{path.name} is still locked" for path in _held(world.home / ".leases"))


def _held(folder: Path) -> Iterator[Path]:
    """Lock files that somebody holds."""
    for path in folder.rglob("*.lock"):
        with path.open("a+") as handle:
            try:
                fcntl.flock(handle.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                yield path


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
