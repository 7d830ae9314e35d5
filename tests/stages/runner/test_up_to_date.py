"""What is up to date: content decides, not its place or its times."""

import contextlib
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from nvsf_core.drives.catalogue import SceneEntry, load_catalogue
from nvsf_core.drives.entries import ViewEntry
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.errors import DataError
from nvsf_core.stages import STAGES, plan_run, run_named_stage
from nvsf_core.stages.runner.locks import LOCKS, file_lock
from nvsf_core.stages.runner.run import run_scene
from nvsf_core.stages.runner.stage import Stage, StageOutput
from nvsf_core.stages.runner.verify import Verdict, verify_scene

PREPARED = STAGES[:4]
Prepare = Callable[[SceneEntry, Path], list[str]]


@pytest.fixture(scope="module")
def drive(tiny_catalogue: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive and a home, prepared up to `undistorted`, side by side."""
    folder = tmp_path_factory.mktemp("moved")
    shutil.copytree(tiny_catalogue.parent / "drive", folder / "drive")
    _prepare(_entry(tiny_catalogue, folder), folder / "home")
    return folder


@pytest.fixture
def copy(drive: Path, tmp_path: Path) -> Path:
    shutil.copytree(drive, tmp_path / "copy", copy_function=shutil.copy)  # other places, times and inodes
    return tmp_path / "copy"


def _entry(catalogue: Path, folder: Path) -> SceneEntry:
    entry = next(one for one in load_catalogue([catalogue], None) if one.name == "tiny")
    return replace(entry, root=folder / "drive")


def _prepare(entry: SceneEntry, home: Path, said: list[str] | None = None) -> list[str]:
    """Run the stages; names of those that were not skipped."""
    progress = (lambda line: None) if said is None else said.append
    done = run_scene(entry, home, recipe="smoke", progress=progress, stages=PREPARED)
    return [one.stage for one in done if not one.skipped]


def test_a_copied_drive_and_home_are_up_to_date(copy: Path, tiny_catalogue: Path) -> None:
    assert _prepare(_entry(tiny_catalogue, copy), copy / "home") == []


def test_changed_bytes_are_seen_although_size_and_times_stay(copy: Path, tiny_catalogue: Path) -> None:
    entry = _entry(tiny_catalogue, copy)
    path = DriveLayout(entry.root, entry.sequence).scan_path(1)
    found, said = path.stat(), list[str]()
    content = bytearray(path.read_bytes())
    content[12:16], content[28:32] = content[28:32], content[12:16]
    path.write_bytes(content)
    os.utime(path, ns=(found.st_atime_ns, found.st_mtime_ns))
    assert _prepare(entry, copy / "home", said) == ["frames", "sweeps", "pano", "undistorted"]
    assert "[tiny] frames: made again, for the files of the drive changed" in said


def test_frames_that_the_scene_does_not_use_decide_nothing(copy: Path, tiny_catalogue: Path) -> None:
    entry = replace(_entry(tiny_catalogue, copy), last_frame=2)
    _prepare(entry, copy / "home")
    layout = DriveLayout(entry.root, entry.sequence)
    layout.scan_path(3).write_bytes(bytes(16))
    assert _prepare(entry, copy / "home") == []


def test_a_change_that_leaves_the_tables_as_they_are_stops_there(copy: Path, tiny_catalogue: Path) -> None:
    entry = _entry(tiny_catalogue, copy)
    with DriveLayout(entry.root, entry.sequence).poses_path.open("a") as poses:
        poses.write("\n")
    assert _prepare(entry, copy / "home") == ["frames", "sweeps"], "both read the drive itself"


def test_a_new_key_of_the_catalogue_changes_no_fingerprint(copy: Path, tiny_catalogue: Path) -> None:
    entry = _entry(tiny_catalogue, copy)
    assert _prepare(replace(entry, compensate=True, cameras=None, views=()), copy / "home") == []


def test_a_drive_that_changes_while_it_is_read_is_not_published(copy: Path, tiny_catalogue: Path) -> None:
    entry = _entry(tiny_catalogue, copy)
    poses = DriveLayout(entry.root, entry.sequence).poses_path

    def run(task: object) -> StageOutput:
        poses.write_text(poses.read_text() + "\n")
        return StageOutput()

    stage = Stage(
        name="a", group="ingest", inputs=(), description="a", version="1", run=run, reads_drive=True
    )
    with pytest.raises(DataError, match=r"the files of the drive under .* changed while they were read"):
        run_scene(entry, copy / "home", progress=str, stages=[stage])
    assert not (copy / "home/tiny/a").exists()


@pytest.mark.parametrize("key", ["facts", "files", "made_s", "resources", "check_version"])
def test_an_output_whose_record_lacks_something_is_made_again(
    key: str, copy: Path, tiny_catalogue: Path
) -> None:
    entry, path = _entry(tiny_catalogue, copy), copy / "home/tiny/pano/stage.json"
    record = json.loads(path.read_text())
    path.write_text(json.dumps({name: value for name, value in record.items() if name != key}))
    assert _prepare(entry, copy / "home") == ["pano"]
    assert _prepare(entry, copy / "home") == []


def test_what_would_be_made_again_and_what_is_damaged_is_said(copy: Path, tiny_catalogue: Path) -> None:
    entry = _entry(tiny_catalogue, copy)
    run = plan_run(entry, copy / "home", recipe="smoke")
    assert {one.verdict for one in verify_scene(run, PREPARED)} == {Verdict.UP_TO_DATE}
    (copy / "home/tiny/undistorted/stage.json").unlink()
    (copy / "home/tiny/pano/pano.zarr/zarr.json").write_bytes(b"1")
    changed = plan_run(replace(entry, test_frames=(1,)), copy / "home", recipe="smoke")
    found = {one.stage: one for one in verify_scene(changed, PREPARED)}
    assert found["frames"].words == "for the scene's entry in the catalogue (test_frames) changed"
    assert found["pano"].verdict is Verdict.DAMAGED and "pano.zarr" in found["pano"].words
    assert found["undistorted"].verdict is Verdict.ABSENT


def test_damage_is_said_where_no_lock_can_be_made(copy: Path, tiny_catalogue: Path) -> None:
    """As in an archive that cannot be written."""
    run = plan_run(_entry(tiny_catalogue, copy), copy / "home", recipe="smoke")
    (copy / "home/tiny/pano/pano.zarr/zarr.json").write_bytes(b"1")
    shutil.rmtree(copy / "home" / LOCKS)
    (copy / "home" / LOCKS).write_text("no folder")
    found = {one.stage: one.verdict for one in verify_scene(run, PREPARED)}
    assert found.pop("pano") is Verdict.DAMAGED and set(found.values()) == {Verdict.UP_TO_DATE}


def test_an_output_that_a_run_replaces_while_it_is_verified_is_no_damage(
    copy: Path, tiny_catalogue: Path
) -> None:
    run = plan_run(_entry(tiny_catalogue, copy), copy / "home", recipe="smoke")
    array = copy / "home/tiny/pano/pano.zarr/zarr.json"
    content, said = array.read_bytes(), list[str]()
    array.write_bytes(b"1")
    with contextlib.ExitStack() as writer:
        writer.enter_context(file_lock(copy / "home" / LOCKS / "tiny/pano.lock", str, ""))

        def end(line: str) -> None:
            said.append(line)
            array.write_bytes(content)
            writer.close()

        found = {one.stage: one.verdict for one in verify_scene(run, PREPARED, end)}
    assert set(found.values()) == {Verdict.UP_TO_DATE}
    assert said == ["waiting for pano, which another run writes (0 s)"]


def test_verify_reads_bytes_anew_whatever_is_remembered_of_them(copy: Path, tiny_catalogue: Path) -> None:
    entry = _entry(tiny_catalogue, copy)
    _prepare(entry, copy / "home")
    path = DriveLayout(entry.root, entry.sequence).scan_path(1)
    content = bytearray(path.read_bytes())
    content[12:16], content[28:32] = content[28:32], content[12:16]
    path.write_bytes(content)
    # As after a change that all of the file's facts hide.
    known, now = copy / "home/.hashes/tiny.json", path.stat()
    memory = json.loads(known.read_text())
    memory["files"][str(path)][:4] = [now.st_size, now.st_mtime_ns, now.st_ctime_ns, now.st_ino]
    known.write_text(json.dumps(memory))
    (frames, *_) = verify_scene(plan_run(entry, copy / "home", recipe="smoke"), PREPARED)
    assert frames.verdict is Verdict.CHANGED and frames.words == "for the files of the drive changed"


def test_a_view_s_place_of_true_images_decides_nothing_its_cameras_do(tiny_catalogue: Path) -> None:
    from nvsf_core.stages.runner.facts import view_facts

    entry = _entry(tiny_catalogue, Path())
    one, other = (replace(entry, views=(_view("v", place),)) for place in ("here", "there"))
    assert view_facts(one) == view_facts(other) != view_facts(replace(entry, views=(ViewEntry(name="v"),)))


def _view(name: str, place: str) -> ViewEntry:
    return ViewEntry(name=name, truth=(("image_00", Path(place)),))


def test_a_stage_that_reads_a_changed_home_is_named(copy: Path, tiny_catalogue: Path) -> None:
    run = plan_run(replace(_entry(tiny_catalogue, copy), test_frames=(1,)), copy / "home", recipe="smoke")
    said: list[str] = []
    run_named_stage("frames", run, said.append)
    assert said[0].startswith("[tiny] frames: made again, for the scene's entry in the catalogue")
