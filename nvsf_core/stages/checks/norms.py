"""Norms of the training scans (hit rate, intensities), and checks of rendered scans against them."""

from collections.abc import Mapping

import numpy as np

from nvsf_core.metrics.norms import ScanNorms, scan_norms
from nvsf_core.stages.runner.stage import Check, NamedCheck
from nvsf_core.stores.arrays import read_arrays
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows

NO_NORMS = "no training scan with returns to compare with"
LEVER = 1.1
"""Largest valid range over the sensor's: room for lever arms and the way driven during a sweep."""
_RATE_WORDS, _SPREAD_WORDS = "{:+.3f} of the rays", "intensities {:.3f} apart"
Apart = list[tuple[float, str]]
"""Distance of each scan from the recorded ones, signed or not, and the scan's name."""


def read_norms(store: SceneStore) -> ScanNorms | None:
    """Norms of the drive's training scans; None if no training scan has returns."""
    folder = store.require("sweeps") / "returns.zarr"
    if read_arrays(folder, "frame")["frame"].size == 0:
        return None
    a = read_arrays(folder, "frame", "time_s", "firings", "offsets", "laser", "intensity")
    return norms_of(a, np.isin(a["frame"], training_frames(store)))


def training_frames(store: SceneStore) -> list[int]:
    """Numbers of the drive's training frames, usable or not."""
    rows = read_rows(store.require("frames") / "frames.parquet")
    return [row["frame"] for row in rows if row["split"] == "train"]


def norms_of(arrays: Mapping[str, np.ndarray], is_training: np.ndarray) -> ScanNorms | None:
    """As `read_norms`, from the arrays of `sweeps/returns.zarr`; `is_training` is (scans,) bool."""
    lengths = np.diff(arrays["offsets"])
    used = is_training & (arrays["firings"] > 0) & (lengths > 0)
    of_used = np.repeat(used, lengths)
    lasers = np.unique(arrays["laser"][of_used])
    if not (lasers >= 0).any():
        return None
    return scan_norms(
        arrays["time_s"][used],
        arrays["firings"][used],
        int((lasers >= 0).sum()),
        np.concatenate([[0], np.cumsum(lengths[used])]),
        arrays["intensity"][of_used],
    )


def check_likeness(
    hit_rate: NamedCheck, intensity: NamedCheck, rates: Apart, spreads: Apart, norms: ScanNorms
) -> list[Check]:
    """Check hit rates and intensities by the worst scan of each.

    Args:
        hit_rate: The check of hit rates.
        intensity: The check of intensity histograms.
        rates: Per scan, difference of hit rates and the scan's name.
        spreads: Per scan, distance of intensity histograms and the scan's name.
        norms: Of the training scans; they give the limits.

    Returns:
        The outcomes of `hit_rate` and `intensity`.
    """
    return [
        _check_worst(hit_rate, rates, norms.hit_rate_limit, _RATE_WORDS),
        _check_worst(intensity, spreads, norms.intensity_limit, _SPREAD_WORDS),
    ]


def _check_worst(named: NamedCheck, apart: Apart, limit: float, words: str) -> Check:
    if not apart:
        return named.not_run("no scan by the recording sensor with returns on both sides")
    worst, place = max(apart, key=lambda one: abs(one[0]))
    beyond = sum(abs(distance) > limit for distance, _ in apart)
    detail = f"worst {words.format(worst)} ({place}); {beyond} of {len(apart)} scans beyond {limit:.3f}"
    return named.outcome(abs(worst), limit, detail)
