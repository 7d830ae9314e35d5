"""A drive is known by its content: another one of its name replaces nothing, its own corrections do."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from nvsf_core.drives.catalogue import SceneEntry, load_catalogue
from nvsf_core.stages import STAGE_NAMES, STAGES, run_scene
from nvsf_core.stages.runner.failures import remembered_failures
from nvsf_core.stages.runner.same_drive import OtherDriveError, other_root, require_same_drive
from nvsf_core.stores.scene_store import SceneStore


@pytest.fixture
def entry(tiny_catalogue: Path, tmp_path: Path) -> SceneEntry:
    """A scene whose drive is a copy, ingested into the home beside it."""
    shutil.copytree(tiny_catalogue.parent / "drive", tmp_path / "drive")
    scene = next(one for one in load_catalogue([tiny_catalogue], None) if one.name == "tiny")
    scene = replace(scene, root=tmp_path / "drive")
    _ingest(scene, tmp_path)
    return scene


def _ingest(scene: SceneEntry, folder: Path) -> list[str]:
    """Make `frames` and `sweeps`; what was said."""
    said: list[str] = []
    run_scene(scene, folder / "home", recipe="smoke", progress=said.append, stages=STAGES[:2])
    return said


def _copied(scene: SceneEntry, place: Path, pattern: str) -> SceneEntry:
    """The scene with a copy of its drive, in which the files of the pattern are other ones."""
    shutil.copytree(scene.root, place)
    for path in place.rglob(pattern):
        if path.is_file():
            path.write_bytes(path.read_bytes() + b"\n")
    return replace(scene, root=place)


def test_another_drive_of_the_name_is_refused_and_replaces_nothing(entry: SceneEntry, tmp_path: Path) -> None:
    store = SceneStore(tmp_path / "home", entry.name)
    before = {path: path.read_bytes() for path in store.root.rglob("*") if path.is_file()}
    other = _copied(entry, tmp_path / "other", "*")
    for _ in range(2):  # what was refused is not remembered as the scene's drive
        with pytest.raises(OtherDriveError, match=rf"another drive of that name: {entry.root};.*--name"):
            _ingest(other, tmp_path)
    assert {path: path.read_bytes() for path in store.root.rglob("*") if path.is_file()} == before
    assert remembered_failures(tmp_path / "home", STAGE_NAMES) == {}
    assert other_root(store, other) == entry.root and other_root(store, entry) is None
    (store.root / ".drive.json").unlink()  # as the message says
    require_same_drive(store, other, print)


def test_a_moved_drive_stays_the_same_and_its_new_place_is_remembered(
    entry: SceneEntry, tmp_path: Path
) -> None:
    moved = _copied(entry, tmp_path / "moved", "no file")
    assert any("frames: up to date" in line for line in _ingest(moved, tmp_path))
    assert other_root(SceneStore(tmp_path / "home", entry.name), moved) is None


@pytest.mark.parametrize("place", ["drive", "moved"])
def test_a_corrected_drive_goes_on_and_says_what_is_replaced(
    entry: SceneEntry, tmp_path: Path, place: str
) -> None:
    if place != "drive":
        entry = _copied(entry, tmp_path / place, "no file")
    (poses,) = entry.root.rglob("poses.txt")
    poses.write_bytes(poses.read_bytes() + b"\n")
    said = _ingest(entry, tmp_path)
    assert len([line for line in said if "1 of its files are not those" in line and "poses.txt" in line]) == 1
    assert not any("not those" in line for line in _ingest(entry, tmp_path))


def test_a_drive_that_was_exchanged_in_its_place_is_the_user_s_own(entry: SceneEntry, tmp_path: Path) -> None:
    for path in entry.root.rglob("*.*"):
        path.write_bytes(path.read_bytes() + b"\n")
    require_same_drive(SceneStore(tmp_path / "home", entry.name), entry, print)
