"""Parts of a cut drive as sections of one: one clock, and objects that were found in two parts are one.

Each part counts seconds from its own first frame, and numbers what it found to move by itself.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.stages.views.instances import FOUND

_WITH_OBJECTS = ("boxes", "instances")
_SAME_OBJECT_M = 1.0
"""Boxes of one object that two parts found lie so near to each other, in the median of the shared frames."""


def on_one_clock(manifests: Sequence[dict[str, Any]], first_frames: Sequence[int]) -> list[dict[str, Any]]:
    """The manifests with times of scans and images since the first part's first frame.

    Parts are placed by the frames that they share; without any, by the frames' usual distance.

    Args:
        manifests: Of the parts' data sets, in the order of the drive.
        first_frames: First frame of each part: its own clock is 0 there.

    Raises:
        DataError: Of two neighbours only the first frames are there, which tell no distance of frames.
    """
    found, begin_s = list(manifests[:1]), 0.0
    for manifest, (before, first) in zip(manifests[1:], itertools.pairwise(first_frames), strict=True):
        begin_s = _later_s(found[-1], (before, begin_s), manifest, (first, 0.0))
        rows = {
            kind: [{**row, **{name: row[name] + begin_s for name in _times(row)}} for row in manifest[kind]]
            for kind in ("scans", "images")
        }
        found.append({**manifest, **rows})
    return found


def _times(row: Mapping[str, Any]) -> list[str]:
    return [name for name in ("time_s", "stamp_s") if name in row]


def _later_s(
    before: Mapping[str, Any],
    before_begin: tuple[int, float],
    after: Mapping[str, Any],
    after_begin: tuple[int, float],
) -> float:
    """Seconds from the beginning of one part's clock to that of the next, by the parts' manifests.

    Begins are a part's first frame, and when that is on the manifest's clock.
    """
    sooner, later = _seconds(before), _seconds(after)
    shared = sorted(set(sooner) & set(later))
    if shared:
        return float(np.median([sooner[number] - later[number] for number in shared]))
    if not sooner:
        return 0.0
    last, first = max(sooner), min(later, default=0)
    step_s = _step_s(sooner) or _step_s(dict([before_begin]) | sooner)
    step_s = step_s or _step_s(dict([after_begin]) | later)
    if step_s == 0.0:
        raise DataError(
            f"expected two frames of one part, found the first frames {last} and {first} of two alone: the "
            "time between frames is not known; ask for one frame more"
        )
    return sooner[last] + step_s * (first - last) - later.get(first, 0.0)


def _step_s(time_s: Mapping[int, float]) -> float:
    """Usual seconds from frame to frame, of the times of some; 0 if there are not two."""
    return (time_s[max(time_s)] - time_s[min(time_s)]) / max(1, max(time_s) - min(time_s))


def _seconds(manifest: Mapping[str, Any]) -> dict[int, float]:
    """Time of each frame that has one; of its scan where there is one."""
    rows = [row for kind in ("images", "scans") for row in manifest[kind] if "time_s" in row]
    return {row["number"]: row["time_s"] for row in rows}


def with_shared_objects(manifests: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The manifests with numbers of found objects that hold over the drive.

    An object that two neighbours found in the frames that they share has one number; all found objects'
    come after those of all labelled ones.
    """
    free = 1 + max(
        (box["object_id"] for one in manifests for box in one["boxes"] if box["label"] != FOUND), default=0
    )
    done: list[dict[str, Any]] = []
    for manifest in manifests:
        known = _places(done[-1]) if done else {}
        new: dict[int, int] = {}
        for own, places in _places(manifest).items():
            same = _nearest(places, {one: at for one, at in known.items() if one not in new.values()})
            new[own], free = (free, free + 1) if same is None else (same, free)
        done.append(
            {
                **manifest,
                **{kind: [_numbered(row, new) for row in manifest.get(kind, [])] for kind in _WITH_OBJECTS},
            }
        )
    return done


def _numbered(row: dict[str, Any], new: Mapping[int, int]) -> dict[str, Any]:
    return {**row, "object_id": new[row["object_id"]]} if row["object_id"] in new else row


def _places(manifest: Mapping[str, Any]) -> dict[int, dict[int, np.ndarray]]:
    """Middle (3,) of each found object at each frame, metres."""
    found: dict[int, dict[int, np.ndarray]] = {}
    for box in manifest["boxes"]:
        if box["label"] == FOUND and box["number"] is not None:
            pose = np.array(box["box_to_world"], np.float64).reshape(4, 4)
            found.setdefault(box["object_id"], {})[box["number"]] = pose[:3, 3]
    return found


def _nearest(places: Mapping[int, np.ndarray], known: Mapping[int, Mapping[int, np.ndarray]]) -> int | None:
    """The known object that is at the same places; None if there is none."""
    apart_m = {}
    for one, there in known.items():
        shared = sorted(set(places) & set(there))
        if shared:
            apart_m[one] = float(np.median([np.linalg.norm(places[k] - there[k]) for k in shared]))
    best = min(apart_m, key=lambda one: apart_m[one], default=None)
    return None if best is None or apart_m[best] > _SAME_OBJECT_M else best
