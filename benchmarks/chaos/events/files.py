"""Files that change: published ones that are cut or have a flipped bit, and a drive while it is read."""

import time
from pathlib import Path

from benchmarks.chaos.event import Event, Harm, Random
from benchmarks.chaos.world import LONGEST_RUN_S, SCENE, World
from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.stages.versions import Version, damage_of_version, make_anew, versions_of
from nvsf_core.stores.scene_store import published

_CHANGED = r"made again|frames: done|frames: started"
_REFUSED = r"changed while they were read|changed since the stage|(frames|sweeps|undistorted): .*drive/"
"""Of a file that was half-written at that moment its reader says what is wrong with it."""


def harm_output(world: World, random: Random) -> Harm:
    """Cut, flip or remove one file of what is up to date; the next run must see and mend it."""
    store = world.plan().store
    folders = [store.path(stage.location(world.plan().config)) for stage in world.stages]
    files = [path for folder in folders for path in sorted(folder.rglob("*")) if path.is_file()]
    path = random.choice([path for path in files if path.suffix != ".png"])
    how = _harm(path, random)
    run = world.start()
    code = run.wait(LONGEST_RUN_S)
    name = path.relative_to(store.root).as_posix()
    # Of a record one bit of a number or a word may change and leave it a record.
    expected = "" if path.name == "stage.json" else r"made again, .* is not what was published"
    return Harm(f"{how} {name}; exit {code}", run.said, expected)


def harm_version(world: World, random: Random) -> Harm:
    """Cut, flip or remove one file of any version; `nvsf verify --mend` must find it and make it anew."""
    found = list(versions_of(world.plan().store))
    version = random.choice(found)
    path = random.choice([path for path in sorted(version.folder.rglob("*")) if path.is_file()])
    how = _harm(path, random)
    said = _mended(world, version)
    name = path.relative_to(world.plan().store.root).as_posix()
    return Harm(f"{how} {name}", said, r"made anew")


def _mended(world: World, version: Version) -> str:
    damage = damage_of_version(version)
    if damage is None:
        return "not seen"
    (entry,) = load_catalogue([world.folder / "scenes.toml"], None)
    words: list[str] = [f"DAMAGED ({damage})"]
    words.append("made anew" if make_anew(entry, world.home, version, words.append) else "still damaged")
    return "\n".join(words)


def _harm(path: Path, random: Random) -> str:
    content = bytearray(path.read_bytes())
    kind = random.choice(["flip", "cut", "remove"])
    if kind == "remove" or not content:
        path.unlink()
        return "removed:"
    if kind == "cut":
        path.write_bytes(content[: random.randrange(len(content))])
        return "cut:"
    position = random.randrange(len(content))
    content[position] ^= 1 << random.randrange(8)
    path.write_bytes(content)
    return "a flipped bit:"


def changing_drive(world: World, random: Random) -> Harm:
    """Change bytes of the drive again and again while a run reads it, then put the old ones back."""
    layout, store = world.drive, world.plan().store
    for place in published(store.root, "frames"):
        (place / "stage.json").unlink(missing_ok=True)
    targets = [layout.poses_path, layout.scan_path(1), layout.scan_path(3)]
    run = world.start()
    changes, until_s = 0, time.monotonic() + LONGEST_RUN_S
    while run.is_alive and time.monotonic() < until_s:
        path = random.choice(targets)
        content = bytearray(path.read_bytes())
        if path is layout.poses_path:
            content += b"\n"
        else:
            # A returned point's intensity: any value of it is possible.
            content[12:16] = b"\x00\x00\x80\x3e" if changes % 2 else b"\x00\x00\x00\x3f"
        path.write_bytes(content)
        changes += 1
        time.sleep(random.uniform(0.02, 0.3 if world.bare else 2.0))
    code = run.wait(1.0)
    world.restore_drive()
    expected = _CHANGED if code == 0 else _REFUSED
    return Harm(f"{changes} times; exit {code}", run.said, expected)


EVENTS = [
    Event("harm_output", "a published file is cut, flipped or removed", harm_output, weight=4),
    Event(
        "harm_version", "a file of any version of a data set is cut, flipped or removed", harm_version,
        needs_dagster=True, weight=2,
    ),
    Event("changing_drive", f"the drive of {SCENE} changes while it is read", changing_drive),
]  # fmt: skip
