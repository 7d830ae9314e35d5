"""What was made without an optional tool is made again once the tool is there, and nothing else is."""

import sys
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.clouds.odometry import load_kiss_icp
from nvsf_core.clouds.open3d_room import load_open3d
from nvsf_core.drives.catalogue import SceneEntry, load_catalogue
from nvsf_core.errors import MissingLibraryError
from nvsf_core.metrics.lpips import lpips_measure
from nvsf_core.metrics.lpips_file import WEIGHTS_VARIABLE
from nvsf_core.stages import run_scene
from nvsf_core.stages.optional_tools import tools_now_there
from nvsf_core.stages.runner.stage import Check, Stage, StageOutput, Task


@pytest.fixture
def entry(tiny_catalogue: Path) -> SceneEntry:
    return next(one for one in load_catalogue([tiny_catalogue], None) if one.name == "tiny")


def _said() -> str:
    """What is said of a tool's work: `done`, or that open3d is absent."""
    try:
        load_open3d()
    except MissingLibraryError as error:
        return str(error)
    return "done"


def _mesh(task: Task) -> StageOutput:
    (task.folder / "content").write_text(_said())
    return StageOutput(metadata={"mesh": _said()})


def _scans(task: Task) -> StageOutput:
    (task.folder / "content").write_text("scans")
    return StageOutput()


def _checks(task: Task) -> list[Check]:
    return [Check(name="neighbours_agree", passed=True, detail=_said())]


FLOW = (
    Stage(name="a", group="ingest", inputs=(), description="a", version="1", run=_scans, check=_checks),
    Stage(name="b", group="prepare", inputs=("a",), description="b", version="1", run=_mesh),
    Stage(name="c", group="prepare", inputs=("b",), description="c", version="1", run=_scans),
)


def test_an_output_that_lacked_open3d_is_made_again_when_it_is_installed(
    entry: SceneEntry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    try:
        load_open3d()
    except MissingLibraryError as error:
        pytest.skip(str(error))

    def made() -> tuple[list[str], list[str]]:
        said = list[str]()
        done = run_scene(entry, tmp_path, recipe="smoke", progress=said.append, stages=FLOW)
        details = [check.detail for check in done[0].checks]
        again = [line for line in said if "made again" in line]
        return [one.stage for one in done if not one.skipped], details + again

    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "open3d", None)
        assert made()[0] == ["a", "b", "c"]
        assert made()[0] == [], "it is still absent"
    # Of the first stage only the check lacked it: its output stays.
    stages, said = made()
    assert stages == ["b", "c"]
    assert said == [
        "done",
        "[tiny] b: made again, for open3d, absent when it was made, can be used now",
        "[tiny] c: made again, for its input b changed",
    ]
    assert made() == ([], ["done"])


def test_kiss_icp_is_there_once_it_can_be_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "kiss_icp.config", None)
        with pytest.raises(MissingLibraryError) as caught:
            load_kiss_icp()
        said = f"trust odometry_step_m: {caught.value} (2 times)"
        assert tools_now_there([said]) == []
    (tmp_path / "kiss_icp").mkdir()
    for name in ("__init__", "config", "kiss_icp"):
        (tmp_path / "kiss_icp" / f"{name}.py").write_text("")
        monkeypatch.delitem(sys.modules, f"kiss_icp.{name}".removesuffix(".__init__"), raising=False)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert tools_now_there([said]) == ["KISS-ICP"]
    for name in ("kiss_icp.config", "kiss_icp.kiss_icp", "kiss_icp"):
        sys.modules.pop(name)


def test_lpips_is_there_once_its_weights_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.zeros((40, 40))
    said = ["image image_lpips_squeeze: " + lpips_measure(None, image, image).reason, 3, True]
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "weights.safetensors"))
    assert tools_now_there(said) == [], "a file that is named and not there is no tool"
    (tmp_path / "weights.safetensors").write_bytes(b"any")
    assert tools_now_there(said) == ["the weights of LPIPS"]
    assert tools_now_there(["none", 0.5]) == []
