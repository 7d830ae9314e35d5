"""What does not fit on the disk is refused before it is begun, with figures."""

from pathlib import Path

import pytest

from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.errors import StoreError
from nvsf_core.stages.runner.run import run_scene
from nvsf_core.stages.runner.stage import Stage, StageOutput

EXABYTE = 10**18


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
