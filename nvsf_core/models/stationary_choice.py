"""Where the sensor rested: whether scans are combined or the nearest one is copied, by left-out scans."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.models.holdout import SCAN_METRICS, compare, left_out_renderer, recorded_pano, score_left_out
from nvsf_core.recipe import EvidenceSpec
from nvsf_core.recording.drive import LidarRecording


def choose_copying(lidar: LidarRecording) -> tuple[LidarRecording, dict[str, Scalar]]:
    """The recording, whose stationary scans are copied where that is better, and the scores of both.

    Combined scans have less noise; but where everything stands, the scan before is hard to beat: it repeats
    what the sensor sees again and again, whether a surface explains it or not. Compared are those validation
    scans at which the sensor rested, rendered by `reproject`; without any, scans are combined.
    """
    stationary, left_out = lidar.evidence.stationary, lidar.evidence.left_out
    if stationary is None or left_out is None:
        return lidar, {}
    numbers = np.intersect1d(left_out.validation, stationary.scan).tolist()
    if not numbers:
        return lidar, {}
    copying = replace(lidar, evidence=replace(
        lidar.evidence, stationary=replace(stationary, is_copied=np.array(True))
    ))  # fmt: skip
    truth = {number: recorded_pano(lidar, number) for number in numbers}

    def scores(recording: LidarRecording) -> Callable[[int], list[float]]:
        return lambda number: score_left_out(
            left_out_renderer(lidar, left_out, number), EvidenceSpec().votes, recording, number, truth[number]
        )

    found = compare(SCAN_METRICS, numbers, {"combined": scores(lidar), "copied": scores(copying)})
    chosen = copying if found.wins("copied", "combined") else lidar
    figures = found.figures({"combined": "stationary_combined_", "copied": "stationary_copied_"})
    return chosen, {"stationary_shows": "copied" if chosen is copying else "combined", **figures}
