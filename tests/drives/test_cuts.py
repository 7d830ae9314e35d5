"""A long drive is cut into overlapping scenes that have every frame, and a joined data set has each once."""

import itertools
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.drives.cuts import cut_scene, parts_of
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.view_entry import ViewEntry
from nvsf_core.errors import DataError


def _scene(first: int, count: int, **values: object) -> SceneEntry:
    return SceneEntry(
        name="long", root=Path("/d"), sequence="s", first_frame=first, last_frame=first + count - 1,
        test_frames=tuple(range(first + 3, first + count, 10)), **values,
    )  # fmt: skip


@given(
    first=st.integers(0, 1000),
    count=st.integers(5, 3000),
    cut=st.integers(5, 200),
    share=st.floats(0.0, 0.49),
)
def test_parts_have_every_frame_and_each_is_of_one(first, count, cut, share):
    overlap = min(int(share * cut), (cut - 1) // 2)
    parts = cut_scene(_scene(first, count, cut_frames=cut, overlap_frames=overlap))
    assert all(1 <= part.last_frame - part.first_frame + 1 <= cut for part in parts)
    for before, after in itertools.pairwise(parts):
        assert before.last_frame - after.first_frame + 1 >= overlap
    owned = [frame for _, own in parts_of("long", parts) for frame in own]
    assert owned == list(range(first, first + count))
    assert all(
        own[0] >= part.first_frame and own[-1] <= part.last_frame for part, own in parts_of("long", parts)
    )


def test_views_go_to_the_parts_that_have_their_frames():
    views = (ViewEntry(name="all"), ViewEntry(name="two", frames=(3, 95)))
    parts = cut_scene(_scene(0, 100, cut_frames=40, overlap_frames=10, views=views))
    assert [part.name for part in parts] == ["long_000", "long_001", "long_002"]
    assert [[view.name for view in part.views] for part in parts] == [["all", "two"], ["all"], ["all", "two"]]
    assert parts[2].views[1].frames == (95,)
    with pytest.raises(DataError, match="expected frames on the recorded path in a scene that is cut"):
        cut_scene(_scene(0, 100, cut_frames=40, views=(ViewEntry(name="at", times_s=(1.0,)),)))


def test_a_view_of_a_rate_is_of_every_part():
    views = (ViewEntry(name="fast", rate_hz=20.0, frames=()),)
    parts = cut_scene(_scene(0, 100, cut_frames=40, overlap_frames=10, views=views))
    assert [[view.name for view in part.views] for part in parts] == [["fast"]] * 3


def test_a_catalogue_lists_the_parts(tmp_path):
    entry = '[[scene]]\nname = "a"\nroot = "d"\nsequence = "s"\nfirst_frame = 0\nlast_frame = 99\n'
    text = entry + "test_frames = [5]\ncut_frames = 60\n"
    (tmp_path / "c.toml").write_text(text)
    parts = load_catalogue([tmp_path / "c.toml"], None)
    assert [(one.name, one.first_frame, one.last_frame) for one in parts] == [
        ("a_000", 0, 59),
        ("a_001", 40, 99),
    ]
    assert all(one.cut_frames is None for one in parts)
    (tmp_path / "c.toml").write_text(text + "overlap_frames = 30\n")
    with pytest.raises(DataError, match="overlap_frames: expected 0 to less than half"):
        load_catalogue([tmp_path / "c.toml"], None)
    (tmp_path / "c.toml").write_text(text + entry.replace('"a"', '"a_000"') + "test_frames = []\n")
    with pytest.raises(DataError, match="has the name of another scene"):
        load_catalogue([tmp_path / "c.toml"], None)
    with pytest.raises(DataError, match="expected parts of a scene 'b'"):
        parts_of("b", parts)
