"""Which files of a drive a scene reads, and whether they are all there."""

import contextlib
import time
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """Files of a scene's section of a drive, as they are on disk now."""

    files: tuple[Path, ...]
    """Everything there that the scene reads: calibration, poses, times, boxes, then scans and images."""
    folders: tuple[Path, ...]
    """Folders of scans and images that exist: they say which sensors the drive has."""
    missing: tuple[str, ...]
    """Files without which nothing can be made, below the root."""
    gaps: tuple[str, ...]
    """Scans and images that lack, of sensors that have a folder, below the root."""
    recorded: tuple[int, int] | None
    """First and last frame that the whole drive has; timestamps are counted from there."""


GAPS_WAIT = 30
"""How many times longer a drive that lacks scans or images has to lie unchanged before it counts as whole."""


def why_wait(section: Section, quiet_s: float) -> str:
    """Why a drive is not whole yet: something of it changed in the last `quiet_s` seconds; empty if it is.

    The change times of files say when they came here, whatever modification times a copy gave them. They
    cannot be set by anybody, and a drive that is moved within a disk keeps its own.
    """
    if not section.folders or not section.files:
        return "no scan or image yet"
    if section.missing:
        return f"{', '.join(section.missing)} not there yet"
    # A clock that was set back shows times to come: they too only count while they are near.
    age_s = abs(time.time() - _newest_s(section))
    if age_s < quiet_s:
        return f"something changed {age_s:.0f} s ago; {quiet_s:.0f} s without a change are awaited"
    if section.gaps and age_s < GAPS_WAIT * quiet_s:
        return (
            f"{len(section.gaps)} scans or images lack, as {section.gaps[0]}; {GAPS_WAIT * quiet_s:.0f} s "
            "without a change are awaited"
        )
    return ""


def _newest_s(section: Section) -> float:
    """When the last of the section's files and folders changed, seconds since the epoch."""
    newest_s = 0.0
    for path in (*section.files, *section.folders):
        with contextlib.suppress(FileNotFoundError):
            newest_s = max(newest_s, path.stat().st_ctime)
    return newest_s
