"""The drive's labelled boxes at the instants of a view."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from nvsf_core.stages.exports.records import BoxRecord
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows

_SAME_S = 1e-6


def boxes_at(
    rows: Sequence[Mapping[str, Any]], frame_time_s: Mapping[int, float], time_s: np.ndarray
) -> Callable[[int], list[BoxRecord]]:
    """Gives the boxes at one of the instants of a view.

    A moving object's box between two frames lies between its boxes in these; it is absent before its first
    and after its last. Over a tenth of a second the mean of two poses is a rotation to 1e-4.

    Args:
        rows: Of `boxes.parquet`: frame (below 0 = static), object_id, label, dynamic, box_to_world.
        frame_time_s: Frame to its time.
        time_s: (n,) instants of the scene.
    """
    tracks: dict[int, list[tuple[float, Mapping[str, Any]]]] = {}
    static: dict[int, Mapping[str, Any]] = {}
    for row in rows:
        if not row["dynamic"]:
            static[row["object_id"]] = row
        elif row["frame"] in frame_time_s:
            tracks.setdefault(row["object_id"], []).append((frame_time_s[row["frame"]], row))
    for track in tracks.values():
        track.sort(key=lambda one: one[0])

    def at(number: int) -> list[BoxRecord]:
        moving = [_between(track, float(time_s[number])) for track in tracks.values()]
        return [_record(row, _matrix(row)) for row in static.values()] + [
            one for one in moving if one is not None
        ]

    return at


def boxes_of(store: SceneStore, time_s: np.ndarray) -> Callable[[int], list[BoxRecord]]:
    """Gives the drive's labelled boxes at one of the instants (n,) of a view; none if it has none."""
    folder = store.require("frames")
    if not (folder / "boxes.parquet").is_file():
        return lambda index: []
    frames = {row["frame"]: row["time_s"] for row in read_rows(folder / "frames.parquet")}
    return boxes_at(read_rows(folder / "boxes.parquet"), frames, time_s)


def _between(track: Sequence[tuple[float, Mapping[str, Any]]], time_s: float) -> BoxRecord | None:
    known_s = np.array([known for known, _ in track])
    if not known_s[0] - _SAME_S <= time_s <= known_s[-1] + _SAME_S:
        return None
    after = int(np.clip(np.searchsorted(known_s, time_s), 0, len(known_s) - 1))
    before = max(0, after - 1) if known_s[after] > time_s + _SAME_S else after
    length_s = known_s[after] - known_s[before]
    share = 0.0 if length_s <= 0.0 else (time_s - known_s[before]) / length_s
    pose = (1.0 - share) * _matrix(track[before][1]) + share * _matrix(track[after][1])
    return _record(track[before][1], pose)


def _matrix(row: Mapping[str, Any]) -> np.ndarray:
    return np.array(row["box_to_world"], np.float64).reshape(4, 4)


def _record(row: Mapping[str, Any], pose: np.ndarray) -> BoxRecord:
    return BoxRecord(
        object_id=int(row["object_id"]), label=str(row["label"]), is_dynamic=bool(row["dynamic"]),
        box_to_world=pose,
    )  # fmt: skip
