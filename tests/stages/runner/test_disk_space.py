"""What does not fit on the disk is refused before it is begun, with figures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.clouds.ply import write_ply
from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.errors import StoreError
from nvsf_core.stages import STAGES
from nvsf_core.stages.imports.convert import import_drive
from nvsf_core.stages.runner import resources
from nvsf_core.stages.runner.run import run_scene
from nvsf_core.stages.runner.stage import Stage, StageOutput

EXABYTE = 10**18
RETURN_BYTES = 16
"""In a scan file."""


def test_an_output_that_does_not_fit_is_not_begun(tiny_catalogue: Path, tmp_path: Path) -> None:
    entry = next(one for one in load_catalogue([tiny_catalogue], None) if one.name == "tiny")
    begun: list[str] = []

    def stage(name: str, size: int) -> Stage:
        return Stage(
            name=name, group="ingest", inputs=(), description=name, version="1",
            run=lambda task: begun.append(name) or StageOutput(), estimate_bytes=lambda task: size,
        )  # fmt: skip

    run_scene(entry, tmp_path, progress=str, stages=[stage("small", 1)])
    words = r"large: not begun, for it writes about 1,000,000,000,000 MB, and .* MB free"
    with pytest.raises(StoreError, match=words):
        run_scene(entry, tmp_path, progress=str, stages=[stage("large", EXABYTE)])
    assert begun == ["small"] and not (tmp_path / "tiny/large").exists()


def _with_ply_scans(entry: SceneEntry, root: Path) -> SceneEntry:
    """The drive as plain files whose scans are PLY."""
    import_drive(entry, root, progress=str)
    for path in list(root.rglob("*.bin")):
        points = np.fromfile(path, np.float32).reshape(-1, 4)
        write_ply(path.with_suffix(".ply"), points[:, :3], points[:, 3])
        path.unlink()
    return replace(entry, root=root, kind="plain")


@pytest.mark.parametrize("suffix", [".bin", ".ply"])
def test_sweeps_that_do_not_fit_are_refused_by_the_size_of_the_scans(
    tiny_catalogue: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    entry = next(one for one in load_catalogue([tiny_catalogue], None) if one.name == "tiny")
    scans = [path for path in entry.root.rglob("*.bin") if path.parent.name == "data"]
    recorded = sum(path.stat().st_size for path in scans)
    estimate = 54 * (recorded // RETURN_BYTES)
    if suffix == ".ply":
        entry = _with_ply_scans(entry, tmp_path / "plain")
    run_scene(entry, tmp_path, progress=str, stages=STAGES[:1])
    words = f"stage sweeps: not begun, for it writes about {estimate:,} MB"
    with monkeypatch.context() as patched:
        patched.setattr(resources, "_MB", 1.0)  # the message's figures in bytes
        patched.setattr(resources, "SPARE_BYTES", EXABYTE)
        with pytest.raises(StoreError, match=words):
            run_scene(entry, tmp_path, progress=str, stages=STAGES[:2])
    assert not (tmp_path / "tiny/sweeps").exists()
    run_scene(entry, tmp_path, progress=str, stages=STAGES[:2])
    chunks = (tmp_path / "tiny/sweeps").glob("*.zarr/*/c/**/*")
    written = sum(path.stat().st_size for path in chunks if path.is_file())
    assert written < estimate < 3 * written
