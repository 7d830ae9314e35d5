"""What somebody names by `--out` does not lie where a later run removes it."""

from pathlib import Path

import pytest

from nvsf_core.drives.entries import SceneEntry
from nvsf_core.errors import DataError
from nvsf_core.stages.exports.join import join_data_sets
from nvsf_core.stages.imports.convert import import_drive
from nvsf_core.stages.render_view import render_view
from nvsf_core.stages.runner.own_places import require_place_of_yours

OURS = [
    "street/sweeps/mine", "street/mesh", "street/dataset/x", "street/.failed/x", ".runs/x", "dagster",
    "benchmark_report/mine", "drives/../street/field",
]  # fmt: skip
YOURS = ["drives/mine", "drives/frames", "drives/.mine/sweeps", "mine", "street/mine", "../beside"]


@pytest.mark.parametrize("place", OURS)
def test_a_place_of_the_project_s_is_refused_and_another_named(tmp_path: Path, place: str) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "link").symlink_to("home")
    for home, out in (("home", "home"), ("link", "home"), ("home", "link")):
        with pytest.raises(DataError, match=r"folder of your own.*home/drives/NAME"):
            require_place_of_yours(tmp_path / out / place, tmp_path / home)


@pytest.mark.parametrize("place", YOURS)
def test_a_place_that_no_run_touches_is_taken(tmp_path: Path, place: str) -> None:
    require_place_of_yours(tmp_path / "home" / place, tmp_path / "home")


def test_whatever_makes_a_folder_by_name_refuses_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NVSF_HOME", str(tmp_path / "home"))
    scene = SceneEntry(
        name="street", root=tmp_path / "drive", sequence="s", first_frame=0, last_frame=3, test_frames=()
    )
    out = tmp_path / "home/street/sweeps/mine"
    for make in (
        lambda: import_drive(scene, out, progress=print),
        lambda: render_view(scene, {}, out=out),
        lambda: join_data_sets("street", [], [], out),
    ):
        with pytest.raises(DataError, match="folder of your own"):
            make()
    assert not (tmp_path / "home").exists()
