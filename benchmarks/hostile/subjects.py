"""What is damaged (a drive, a home, a catalogue, the choices of a run), and how the run then ends."""

import contextlib
import hashlib
import shutil
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.hostile.limits import End
from benchmarks.hostile.mutations import MOST_BYTES, ODD_NUMBERS, Random, mutate, one_of
from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry, ViewEntry, load_catalogue
from nvsf_core.errors import NvsfError
from nvsf_core.stages import STAGES, SceneRun, plan_run, run_named_stage, run_scene
from nvsf_core.stages.benchmark_report import make_benchmark_report
from nvsf_core.stages.field import load_trained
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.record import damage_of, read_record
from nvsf_core.stores.arrays import read_arrays, read_attrs
from nvsf_core.stores.checkpoints import load_tensors
from nvsf_core.stores.documents import read_document
from nvsf_core.stores.tables import read_rows

PREPARED = ("frames", "sweeps", "pano", "undistorted", "evidence")
CATALOGUE = """
[[scene]]
name = "tiny"
root = "../drive"
sequence = "2013_05_28_drive_9900_sync"
first_frame = 0
last_frame = 3
test_frames = [2]
sweep_period_s = 0.1
cameras = ["image_00"]
recipe = "smoke"
compensate = true

[[view]]
name = "shift_1m"
scenes = ["tiny"]
sensor = "VLP-16"
shift_m = [0.0, 1.0, 0.0]
yaw_deg = 5.0
frames = [1]
exports = ["bin", "ply"]

[[view]]
name = "between"
times_s = [0.05, 0.25]
"""


@dataclass(frozen=True, slots=True)
class Case:
    """One harmed thing."""

    harmed: str
    """Kind of file, or of choice."""
    how: str
    """What was done to it."""
    end: Callable[[], End]
    """Finds out what comes of it; run in a process of its own."""


class Templates:
    """A tiny drive and a trained home, written once and copied for each case."""

    def __init__(self, folder: Path) -> None:
        """Write them, in a process of its own; takes half a minute.

        Libraries start threads as they work, and who has threads should not be forked.
        """
        self.folder = folder
        self.scene = _scene(folder / "drive")
        with ProcessPoolExecutor(1) as made:
            self.prepared, self.doubts, self.stored = made.submit(_make, folder, self.scene).result()

    def drive(self, place: Path, random: Random) -> Case:
        """A drive with one to three files harmed."""
        shutil.copytree(self.folder / "drive", place / "drive", symlinks=True)
        files = sorted(path for path in (place / "drive").rglob("*") if path.is_file())
        kinds, how = [], []
        for _ in range(int(random.choice([1, 1, 1, 2, 3]))):
            path = one_of(files, random)
            if _is_plain(path):
                kinds.append({".bin": "scan", ".png": "image", ".xml": "boxes"}.get(path.suffix, path.name))
                how.append(mutate(path, random))
        return Case("+".join(kinds), ", ".join(how), lambda: self._end_of_drive(place))

    def _end_of_drive(self, place: Path) -> End:
        run = plan_run(_scene(place / "drive"), place / "home")
        _prepare(run)
        doubts = sorted(_doubts(run) - self.doubts)
        if doubts:
            return End("doubted", "; ".join(doubts)[:300])
        return End("harmless" if _digests(run) == self.prepared else "silent")

    def home(self, place: Path, random: Random) -> Case:
        """A trained home with one to three files harmed."""
        shutil.copytree(self.folder / "home", place / "home", symlinks=True)
        run = plan_run(self.scene, place / "home")
        outputs = [run.store.path(stage.location(run.config)) for stage in STAGES]
        outputs += [run.store.path("dataset")]
        kinds, how = [], []
        for _ in range(int(random.choice([1, 1, 2, 3]))):
            files = sorted(path for path in one_of(outputs, random).rglob("*") if _is_plain(path))
            if files:
                path = one_of(files, random)
                kinds.append(f"{path.relative_to(run.store.root).parts[0]}/{path.suffix or 'chunk'}")
                how.append(mutate(path, random))
        return Case("+".join(kinds), ", ".join(how), lambda: self._end_of_home(run))

    def _end_of_home(self, run: SceneRun) -> End:
        """Nobody but an NvsfError may be met by who reads; what changed must be seen; preparing heals."""
        make_benchmark_report(run.store.home, ["tiny"], {}, [])
        contents = _contents(run)
        read = {name for name, found in contents.items() if found != _REFUSED}
        changed = [name for name, found in contents.items() if self.stored.get(name) != found]
        with contextlib.suppress(NvsfError):
            load_trained(run.store.path("field/smoke/0"), read_recording(run.store))
        seen = [stage.name for stage in STAGES if _is_seen(run, stage)]
        if not set(seen) <= set(PREPARED):
            return End("healed", f"made again: {', '.join(seen)}")
        _prepare(run)
        if _digests(run) != self.prepared:
            return End("silent", "prepared outputs differ after they were made again")
        if read & set(changed) and not seen:
            return End("silent", f"changed and read: {', '.join(changed)[:200]}")
        return End("healed" if seen else "harmless", ", ".join(seen))

    def catalogue(self, place: Path, random: Random) -> Case:
        """A catalogue with one to three things done to its text."""
        path = place / "catalogue" / "scenes.toml"
        path.parent.mkdir()
        path.write_text(CATALOGUE)
        shutil.copytree(self.folder / "drive", place / "drive", symlinks=True)
        how = []
        for _ in range(int(random.choice([1, 1, 2, 3]))):
            if _is_plain(path) and path.stat().st_size <= MOST_BYTES:
                how.append(mutate(path, random) if random.random() < 0.6 else _odd_value(path, random))
        return Case("scenes.toml", ", ".join(how), lambda: _end_of_catalogue(path, place / "home"))

    def choice(self, place: Path, random: Random) -> Case:
        """A run's choices, of any kind and value."""
        pool = [*ODD_NUMBERS, *map(_as_number, ODD_NUMBERS), *_ODD_CHOICES]
        names = ("seed", "draw_seed", "dataset_label", "recipe")
        chosen = {name: one_of(pool, random) for name in names if random.random() < 0.5}

        def end() -> End:
            run = plan_run(self.scene, place / "home", **chosen)
            for stage in STAGES:
                path = run.store.path(stage.location(run.config))
                if not path.resolve().is_relative_to((place / "home" / "tiny").resolve()):
                    return End("silent", f"outside: {path}")
            return End("harmless")

        return Case("a run's choices", ", ".join(f"{k}={v!r:.30}" for k, v in chosen.items()), end)


_REFUSED = "refused"
_ODD_CHOICES: tuple[Any, ...] = (
    None, True, [], {}, b"a", 1.5, "../x", "/x", "a\0b", "x" * 300, "lean@0.5", "lean@-1", "lean@", "..", ".",
    "a/../../b", 2**32, -1, "smoke",
)  # fmt: skip
_ODD_VALUES = (
    "[]", "{}", "true", "[[1]]", '"../.."', '"a\\u0000"', "[nan]", "1979-05-27", '["a", 1]', "[1e400]",
    "9" * 50, '"' + "x" * 500 + '"',
)  # fmt: skip


def _scene(drive: Path) -> SceneEntry:
    """The tiny drive's whole section, with one view."""
    view = ViewEntry(name="shift_1m", shift_m=(0.0, 1.0, 0.0), frames=(1,))
    return SceneEntry(
        name="tiny", root=drive, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=3, test_frames=(2,),
        recipe="smoke", views=(view,),
    )  # fmt: skip


def _make(folder: Path, scene: SceneEntry) -> tuple[dict[str, str], set[str], dict[str, str]]:
    """Drive and home; digests of what is prepared, its doubts, and all contents."""
    write_demo(folder / "drive", size=DemoSize.tiny())
    run_scene(scene, folder / "home", progress=lambda line: None)
    run = plan_run(scene, folder / "home")
    return _digests(run), _doubts(run), _contents(run)


def _prepare(run: SceneRun) -> None:
    for stage in PREPARED:
        run_named_stage(stage, run, lambda line: None)


def _end_of_catalogue(path: Path, home: Path) -> End:
    entries = load_catalogue([path], None)
    for entry in entries:
        plan_run(entry, home)
    return End("harmless" if [entry.name for entry in entries] == ["tiny"] else "silent", "other scenes")


def _as_number(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text


def _odd_value(path: Path, random: Random) -> str:
    """One key of the catalogue gets a value of any kind."""
    lines = path.read_text(errors="replace").split("\n")
    keyed = [k for k, line in enumerate(lines) if " = " in line]
    values = [*(f'"{number}"' for number in ODD_NUMBERS), *ODD_NUMBERS, *_ODD_VALUES]
    if keyed:
        at = one_of(keyed, random)
        lines[at] = f"{lines[at].split(' = ')[0]} = {one_of(values, random)}"
        path.write_text("\n".join(lines))
    return "odd value"


def _is_plain(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()


def _doubts(run: SceneRun) -> set[str]:
    """Checks that do not hold, and notes on what was left out."""
    found = set()
    for name in PREPARED:
        record = read_record(run.store.path(name)) or {"checks": [], "metadata": {}}
        about = record["metadata"]
        found |= {check["name"] for check in record["checks"] if not check["passed"]}
        found |= {f"note: {about['notes']}"} if "notes" in about else set()
        found |= {key for key in ("period_assumed", "absurd_returns_dropped") if about.get(key)}
    return found


def _digests(run: SceneRun) -> dict[str, str]:
    """Of every array that the stages published."""
    return {
        f"{group.name}/{name}": _digest(array)
        for stage in PREPARED
        for group in sorted(run.store.path(stage).glob("*.zarr"))
        for name, array in read_arrays(group).items()
    }


def _digest(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array)).hexdigest()


def _contents(run: SceneRun) -> dict[str, str]:
    """Everything that the home holds, as its readers give it; `refused` where they do not."""
    found: dict[str, str] = {}
    for path in sorted(run.store.root.rglob("*")):
        name = path.relative_to(run.store.root).as_posix()
        if ".zarr/" in name or name.startswith(".work"):
            continue
        reader = _READERS.get(path.suffix)
        if reader is not None:
            try:
                found[name] = hashlib.sha256(repr(reader(path)).encode()).hexdigest()
            except NvsfError:
                found[name] = _REFUSED
    return found


def _read_group(path: Path) -> Any:
    return {name: _digest(array) for name, array in read_arrays(path).items()}, dict(read_attrs(path))


def _read_weights(path: Path) -> Any:
    tensors, facts = load_tensors(path)
    return {name: value.numpy().tobytes() for name, value in tensors.items()}, dict(facts)


_READERS: dict[str, Callable[[Path], Any]] = {
    ".zarr": _read_group, ".parquet": read_rows, ".json": read_document, ".safetensors": _read_weights,
}  # fmt: skip


def _is_seen(run: SceneRun, stage: Any) -> bool:
    """Whether the next run would make this stage's output again."""
    location = stage.location(run.config)
    record = read_record(run.store.path(location))
    return record is None or damage_of(run.store, location, record) is not None
