"""What ten scenes and ten thousand take, by what one scene took here: `docs/scaling.md`.

``NVSF_HOME=<home> python -m benchmarks.tables.scaling`` reads the records of every scene of a home that
`quick` trained, takes seconds of training from what `make bench` stored, and times what the daemon does with
a catalogue of many scenes. PRICE (default 0.05) is asked for a core and hour.
"""

import json
import os
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

from benchmarks.common import documents
from benchmarks.common.documents import Row
from nvsf_core.drives.catalogue import home_from_environment, load_catalogue
from nvsf_core.drives.drive import drive_of
from nvsf_core.reporting.scene_outputs import measured_scenes
from nvsf_core.stages.runner.record import RECORD_NAME, read_record
from nvsf_core.stores.scene_store import published
from nvsf_core.stores.tables import read_rows

COUNTS = (10, 10_000)
_WORKERS = (1, 10, 100)
_HOME_RECIPE = "quick"
_RECIPES = (_HOME_RECIPE, "lean")
_A_FILE = 5000
"""Scenes of one catalogue file, which may have 1 MiB."""
_PATTERNS = (f"*/{RECORD_NAME}", f"*/*/*/{RECORD_NAME}", f"dataset/.index/*/*/{RECORD_NAME}")
_ENTRY = """
[[scene]]
name = "scene_{number}"
root = "nowhere"
sequence = "2013_05_28_drive_0000_sync"
first_frame = 0
last_frame = 63
test_frames = [12]
"""


def main() -> None:
    """Measure, store, write."""
    home, price = home_from_environment(os.environ), float(os.environ.get("PRICE") or 0.05)
    scenes = [_taken(home, name) for name in measured_scenes(home)]
    facts = {
        "cores": os.cpu_count(), "price": price, "scenes": scenes,
        "seconds": {recipe: _seconds(recipe, scenes) for recipe in _RECIPES},
        "watching": [_watching(count) for count in COUNTS],
    }  # fmt: skip
    documents.write_measured(documents.RESULTS_DIR / "scaling.json", facts)
    head = documents.measured_on()
    documents.write_between(documents.DOCS / "scaling.md", "one", head + one_scene(scenes))
    documents.write_between(documents.DOCS / "scaling.md", "many", many_scenes(facts))
    documents.write_between(documents.DOCS / "scaling.md", "watching", watching(facts["watching"]))


def _taken(home: Path, scene: str) -> Row:
    """What the newest run of a scene took, as its records say, and what it takes on the disk."""
    root = home / scene
    folders = [path.parent for pattern in _PATTERNS for path in published(root, pattern)]
    records = [record for folder in folders if (record := read_record(folder)) is not None]
    files = [path for path in root.rglob("*") if path.is_file()]
    data = [path for path in files if "dataset" in path.relative_to(root).parts]
    return {
        "scene": scene,
        "frames": len(read_rows(root / "frames" / "frames.parquet")),
        "seconds": sum(record["seconds"] for record in records),
        "train_seconds": sum(
            record["seconds"]
            for record, folder in zip(records, folders, strict=True)
            if folder.relative_to(root).parts[0] == "field"
        ),
        "memory_mb": max(record["resources"].get("peak_memory_mb", 0.0) for record in records),
        "disk_mb": sum(path.stat().st_size for path in files) / 1e6,
        "dataset_mb": sum(path.stat().st_size for path in data) / 1e6,
    }


def _seconds(recipe: str, scenes: list[Row]) -> float:
    """Of a scene from its drive to its data sets: training as `make bench` measured it, the rest beside it.

    The rest (preparation, rendering, metrics) is of the shares of the home's own runs, which `quick` trained.
    """
    train, quick = (_train_seconds(name, scenes) for name in (recipe, _HOME_RECIPE))
    shares = [one["seconds"] / one["train_seconds"] - 1.0 for one in scenes]
    return train + quick * sum(shares) / len(shares)


def _train_seconds(recipe: str, scenes: list[Row]) -> float:
    """Mean over what is stored of the same scenes."""
    found = json.loads((documents.RESULTS_DIR / "recipes" / f"{recipe}.json").read_text())["rows"]
    names = {one["scene"] for one in scenes}
    seconds = [row["train_seconds"] for row in found if row["scene"] in names]
    return float(sum(seconds) / len(seconds))


def _watching(count: int) -> Row:
    """Seconds to read catalogues of many scenes, and to look for each one's drive, as each tick does."""
    with tempfile.TemporaryDirectory() as folder:
        paths = []
        for first in range(0, count, _A_FILE):
            paths.append(Path(folder) / f"scenes_{first}.toml")
            numbers = range(first, min(count, first + _A_FILE))
            paths[-1].write_text("".join(_ENTRY.format(number=number) for number in numbers))
        started_s = time.perf_counter()
        entries = load_catalogue(paths, None)
        read_s = time.perf_counter() - started_s
        for entry in entries:
            drive_of(entry).section()
        look_s = time.perf_counter() - started_s - read_s
        return {"scenes": count, "files": len(paths), "read_seconds": read_s, "look_seconds": look_s}


def one_scene(scenes: Iterable[Row]) -> str:
    """What each measured scene took of memory and disk."""
    head = ["scene", "frames", "memory MB", "disk MB", "of it a version of its data sets"]
    keys = ("memory_mb", "disk_mb", "dataset_mb")
    lines = [[f"`{one['scene']}`", one["frames"], *(f"{one[key]:,.0f}" for key in keys)] for one in scenes]
    return documents.markdown_table(head, lines, "| --- |" + " ---: |" * (len(head) - 1))


def many_scenes(facts: Row) -> str:
    """Hours, disk and cost of many scenes like the mean of the measured ones."""
    scenes, cores, price = facts["scenes"], facts["cores"], facts["price"]
    disk_gb, version_gb = (
        sum(one[key] for one in scenes) / len(scenes) / 1e3 for key in ("disk_mb", "dataset_mb")
    )
    head = [
        "recipe", "scenes", *(f"hours on {count}" for count in _WORKERS), "core hours", "cost", "disk GB",
        "a version GB",
    ]  # fmt: skip
    lines = []
    for recipe, seconds in facts["seconds"].items():
        for count in COUNTS:
            hours = count * seconds / 3600.0
            walls = (f"{hours / min(workers, count):,.1f}" for workers in _WORKERS)
            costs = (f"{hours * cores:,.0f}", f"{hours * cores * price:,.0f}")
            disk = (f"{count * one:,.1f}" for one in (disk_gb, version_gb))
            lines.append([f"`{recipe}`", f"{count:,}", *walls, *costs, *disk])
    frames = sum(one["frames"] for one in scenes) / len(scenes)
    memory_gb = max(one["memory_mb"] for one in scenes) / 1e3
    words = (
        f"\nA scene has {frames:.0f} frames. A worker has {cores} cores, makes one scene at a time and needs "
        f"{memory_gb:.1f} GB of memory for it. The cost is at {price:g} for a core and hour. A version "
        "is that of all data sets of a scene; each week's regeneration adds one.\n"
    )
    return documents.markdown_table(head, lines, "| --- |" + " ---: |" * (len(head) - 1)) + words


def watching(rows: Iterable[Row]) -> str:
    """What the daemon does at each tick of `new_drives`, where no drive is there yet."""
    head = ["scenes", "catalogue files", "read s", "look s"]
    lines = [
        [f"{row['scenes']:,}", row["files"], f"{row['read_seconds']:.2f}", f"{row['look_seconds']:.2f}"]
        for row in rows
    ]
    return documents.markdown_table(head, lines, "|" + " ---: |" * len(head))


if __name__ == "__main__":
    main()
