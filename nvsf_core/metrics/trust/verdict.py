"""Whether a view can be trusted, from its cues and the band that recorded data have among themselves.

A view's score is a plain mean, without weights, so nothing is fitted to views whose truth is known. Fixed by
hand are the limits below. A verdict can only get worse as a cue grows.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.metrics.trust.cues import (
    BAND,
    GUESSED,
    IMAGE_CUES,
    IMAGE_SCORE,
    MISSING,
    PROTOCOL,
    SCAN_CUES,
    SCAN_PATCHES,
    SCAN_SCORE,
    SCORE,
    Cue,
)

LIDAR = "lidar"
NOTICED = 1.1
"""A score within the band, and up to so many times its median, is as recorded."""
TOO_FAR = 2.0
"""Beyond so many times, a view must not be used."""
LITTLE_GUESSED, MUCH_GUESSED = 0.01, 0.25
"""A view of which at most so much is guessed may be as recorded; with more than that it must not be used."""
LITTLE_MISSING, MUCH_MISSING = 0.06, 0.25
"""A view of whose proven returns at most so many are missing may be as recorded; with more than that it must
not be used. Of sound views 0.003 to 0.044 are missing, with a sector of 30 degrees dark 0.067 or more."""
STRANGE = 10.0
"""A cue beyond so many times the largest recorded value makes any view one to use with care."""
EASILY_DISTINGUISHED = 0.9
"""A classifier's area under the ROC curve beyond this makes any view one to use with care. It ends at 1, and
is 0.5 among recorded data: none could be ten times that. Of the views of docs/trust.md it is up to 0.82."""
_LEAST_STRANGE = 1e-3
"""No smaller value is strange: beside scans that are all alike, as without intensity, any other would be."""


class Trust(IntEnum):
    """Verdict on a view; the larger, the worse."""

    AS_RECORDED = 0
    WITH_CARE = 1
    DO_NOT_USE = 2
    NOT_KNOWN = 3

    @property
    def words(self) -> str:
        """In words."""
        return self.name.lower().replace("_", " ")


@dataclass(frozen=True, slots=True)
class Band:
    """Values of a cue that recorded data have among themselves."""

    low: float
    median: float
    high: float

    @classmethod
    def of(cls, values: Iterable[float]) -> "Band | None":
        """The band of values; None without a finite one."""
        finite = [value for value in values if math.isfinite(value)]
        return cls(min(finite), float(np.median(finite)), max(finite)) if finite else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The verdict on one sensor of one view: how far to trust it, and why."""

    view: str
    sensor: str
    trust: Trust
    why: str
    ratio: float
    """Score over the recorded median; NaN if that is not known."""
    values: Mapping[str, float]
    """Metric to its mean over the view's frames."""
    bands: Mapping[str, Band]

    @property
    def score(self) -> float:
        """Its score; NaN if that is not known."""
        return self.values.get(SCORE, math.nan)


def score_of(cues: Mapping[str, float], sensor: str) -> float:
    """A scan's or an image's score from its cues; NaN if one of those that it is made from is missing."""
    parts = [cues.get(cue.name, math.nan) for cue in _score_cues(sensor)]
    if sensor == LIDAR:
        return float(np.mean(parts))
    return float(np.sqrt(np.mean(np.square(parts))))


def verdicts(means: Sequence[Mapping[str, Any]]) -> list[Verdict]:
    """The verdicts on all views and sensors of one run."""
    mine = [row for row in means if row["protocol"] == PROTOCOL]
    found = []
    for view, sensor in dict.fromkeys((row["split"], row["sensor"]) for row in mine):
        own = [row for row in mine if (row["split"], row["sensor"]) == (view, sensor)]
        values = {row["metric"]: float(row["value"]) for row in own if row["region"] == "all"}
        parts: dict[str, dict[str, float]] = {}
        for row in own:
            if row["region"] in BAND:
                parts.setdefault(row["metric"], {})[row["region"]] = float(row["value"])
        bands = {name: Band(*(part[one] for one in BAND)) for name, part in parts.items()}
        found.append(_verdict(view, sensor, values, bands, _scored(own)))
    return found


def _scored(rows: Sequence[Mapping[str, Any]]) -> tuple[int, int]:
    """Of how many of a view's frames the score is known, and how many there are."""
    scores = [row for row in rows if row["region"] == "all" and row["metric"] == SCORE]
    return sum(row["n_defined"] for row in scores), sum(row["n_frames"] for row in scores)


def _verdict(
    view: str, sensor: str, values: Mapping[str, float], bands: Mapping[str, Band], scored: tuple[int, int]
) -> Verdict:
    score, band = values.get(SCORE, math.nan), bands.get(SCORE)
    ratio = math.nan if band is None else score / max(band.median, 1e-12)
    guessed, missing = values.get(GUESSED, 0.0), values.get(MISSING.name, 0.0)
    cues = SCAN_CUES if sensor == LIDAR else IMAGE_CUES
    strange = [cue for cue in cues if values.get(cue.name, 0.0) > _strange_beyond(cue, bands)]
    # No larger than recorded scores and, where these differ much, near their median.
    is_within = band is not None and score <= min(band.high, NOTICED * band.median)
    trust = Trust.WITH_CARE
    if math.isnan(ratio):
        trust = Trust.NOT_KNOWN
    elif ratio > TOO_FAR or guessed > MUCH_GUESSED or missing > MUCH_MISSING:
        trust = Trust.DO_NOT_USE
    elif scored[0] == scored[1] and is_within and not strange:
        # A share that is not known is NaN: it doubts nothing.
        doubted = guessed > LITTLE_GUESSED or missing > LITTLE_MISSING
        trust = Trust.WITH_CARE if doubted else Trust.AS_RECORDED
    why = _why(sensor, trust, values, bands, strange, scored)
    if trust is Trust.NOT_KNOWN and _is_single_image(view, sensor, score, scored):
        why = "It could not be compared: a single image was held out, so that recorded ones have no band."
    return Verdict(
        view=view, sensor=sensor, trust=trust, why=why, ratio=ratio, values=dict(values), bands=dict(bands)
    )


def _is_single_image(view: str, sensor: str, score: float, scored: tuple[int, int]) -> bool:
    """Whether, of a camera without a band, a single image was held out.

    Other views are scored by it, then; itself it is not, as no image measures itself.
    """
    return sensor != LIDAR and (math.isfinite(score) or (view == HELD_OUT and scored[1] == 1))


def _strange_beyond(cue: Cue, bands: Mapping[str, Band]) -> float:
    """Value beyond which a cue makes any view one to use with care; infinite without recorded ones."""
    if cue.name not in bands:
        return math.inf
    if cue.name == SCAN_PATCHES.name:
        return EASILY_DISTINGUISHED
    return max(STRANGE * bands[cue.name].high, _LEAST_STRANGE)


def _why(
    sensor: str, trust: Trust, values: Mapping[str, float], bands: Mapping[str, Band],
    strange: Sequence[Cue], scored: tuple[int, int],
) -> str:  # fmt: skip
    parts, kind = ("rays", "scans") if sensor == LIDAR else ("pixels", "images")
    if trust is Trust.NOT_KNOWN:
        return f"It could not be compared: it has no {kind}, or no recorded ones were left over."
    if trust is Trust.AS_RECORDED:
        return f"It fits the recorded {kind} as well as these fit each other."
    reasons = []
    if scored[0] < scored[1]:
        reasons.append(f"{scored[1] - scored[0]} of its {scored[1]} {kind} could not be compared")
    if values.get(GUESSED, 0.0) > LITTLE_GUESSED:
        share = f"{_percent(values[GUESSED])} of its {parts} look at what nobody recorded"
        reasons.append(f"{share} (marked as guessed, and can be left out)")
    if values.get(MISSING.name, 0.0) > LITTLE_MISSING:
        reasons.append(f"{MISSING.reason} ({_percent(values[MISSING.name])} of these are missing)")
    if strange:
        reasons.append(max(strange, key=lambda cue: values[cue.name] / _strange_beyond(cue, bands)).reason)
    else:
        known = [cue for cue in _score_cues(sensor) if cue.name in bands]
        worst = max(
            known, key=lambda cue: values[cue.name] / max(bands[cue.name].median, 1e-12), default=None
        )
        if worst is not None and values[worst.name] > bands[worst.name].median:
            reasons.append(worst.reason)
    sentence = "; ".join(reasons) or f"taken together it is farther from the recorded {kind} than these are"
    return f"{sentence[0].upper()}{sentence[1:]}."


def _percent(share: float) -> str:
    """A share in words, with a digit more where it is small: 1.4 % is beyond a limit of 1 %."""
    return f"{100.0 * share:.{1 if share < 0.1 else 0}f} %"


def _score_cues(sensor: str) -> tuple[Cue, ...]:
    return SCAN_SCORE if sensor == LIDAR else IMAGE_SCORE
