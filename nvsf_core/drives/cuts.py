"""A long drive cut into scenes of stated length that overlap: each is trained in the memory of one.

Neighbours share frames, so that each knows the street around its border; of a data set that is joined again,
each frame is of the part in whose middle it lies.
"""

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import replace

from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.view_entry import ViewEntry
from nvsf_core.errors import DataError

_DIGITS = 3


def cut_scene(entry: SceneEntry) -> tuple[SceneEntry, ...]:
    """The scenes that an entry with `cut_frames` stands for, `name_000` and on; else the entry itself.

    Parts have at most `cut_frames` frames, are equally long to a frame, and share `overlap_frames` at least.

    Raises:
        DataError: A view asks for a path or times of its own, which belong to one scene only; or a part has
            test frames alone.
    """
    if entry.cut_frames is None:
        return (entry,)
    for view in entry.views:
        if not view.is_on_recorded_path or view.times_s is not None or view.frozen_at_s is not None:
            raise DataError(
                f"view {view.name}: expected frames on the recorded path in a scene that is cut "
                f"(cut_frames = {entry.cut_frames}), found a path or times of its "
                "own; name scenes that are not cut in `scenes`, or give its frames a scene of their own"
            )
    count = entry.last_frame - entry.first_frame + 1
    length, overlap = min(entry.cut_frames, count), entry.overlap_frames
    parts = 1 if count <= length else math.ceil((count - overlap) / (length - overlap))
    found = []
    for part in range(parts):
        begin = entry.first_frame + (0 if parts == 1 else round(part * (count - length) / (parts - 1)))
        end = begin + length - 1
        found.append(
            replace(
                entry, name=f"{entry.name}_{part:0{_DIGITS}d}", first_frame=begin, last_frame=end,
                test_frames=tuple(frame for frame in entry.test_frames if begin <= frame <= end),
                cut_frames=None, views=_views(entry.views, begin, end),
            )
        )  # fmt: skip
    return tuple(found)


def _views(views: Sequence[ViewEntry], begin: int, end: int) -> tuple[ViewEntry, ...]:
    """The views with those of their frames that a part has; without any, a view is not of the part."""
    found = []
    for view in views:
        if view.frames == "all" or view.rate_hz is not None:
            found.append(view)
            continue
        own = tuple(frame for frame in view.frames if not isinstance(frame, str) and begin <= frame <= end)
        if own:
            found.append(replace(view, frames=own))
    return tuple(found)


def parts_of(name: str, catalogue: Sequence[SceneEntry]) -> list[tuple[SceneEntry, range]]:
    """The parts of a scene that was cut, each with the frames of a joined data set that are its own.

    Raises:
        DataError: There are none.
    """
    pattern = re.compile(rf"{re.escape(name)}_\d{{{_DIGITS},}}")
    parts = sorted((one for one in catalogue if pattern.fullmatch(one.name)), key=lambda one: one.first_frame)
    if not parts:
        raise DataError(
            f"expected parts of a scene {name!r} with `cut_frames`, found none in the catalogue: "
            f"{', '.join(one.name for one in catalogue)!s:.300}"
        )
    borders = [
        (before.last_frame + after.first_frame + 1) // 2 for before, after in itertools.pairwise(parts)
    ]
    starts = [parts[0].first_frame, *borders]
    ends = [*borders, parts[-1].last_frame + 1]
    return [(part, range(start, end)) for part, start, end in zip(parts, starts, ends, strict=True)]
