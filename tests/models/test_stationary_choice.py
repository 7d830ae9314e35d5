"""Where the sensor rested, scans are copied if left-out scans show that this is better, and else combined."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.demo.motion import EgoSpeed
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.models.holdout import choose_copying
from nvsf_core.recipe.presets import preset
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.stages.inputs import read_recording
from tests.stages.lidar_drive import proven_drive


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> LidarRecording:
    run = proven_drive(
        tmp_path_factory.mktemp("standing"), preset("smoke"), firings=360, held_out=(4,),
        speed=EgoSpeed(speeds_m_s=(0.0,)),
    )  # fmt: skip
    lidar = read_recording(run.store).lidar
    assert lidar is not None
    return lidar


def with_scans_like_their_neighbours(lidar: LidarRecording) -> LidarRecording:
    """Each validation scan's nearest scans measured the same as it, all others nothing at all."""
    evidence = lidar.evidence
    stationary, left_out = evidence.stationary, evidence.left_out
    assert stationary is not None and left_out is not None
    range_m, time_s = np.zeros_like(stationary.range_m), evidence.prior.time_s[stationary.scan]
    for number in left_out.validation:
        row = int(np.flatnonzero(stationary.scan == number)[0])
        others = np.abs(time_s - time_s[row])
        others[row] = np.inf
        range_m[int(others.argmin())] = stationary.range_m[row]
    return replace(lidar, evidence=replace(evidence, stationary=replace(stationary, range_m=range_m)))


def is_copied(evidence: SceneEvidence) -> bool:
    assert evidence.stationary is not None
    return bool(evidence.stationary.is_copied)


def test_scans_that_repeat_their_neighbour_alone_are_copied(standing: LidarRecording) -> None:
    chosen, figures = choose_copying(with_scans_like_their_neighbours(standing))
    assert is_copied(chosen.evidence)
    assert figures["stationary_shows"] == "copied"
    copied, combined = (figures[f"stationary_{name}_f_score"] for name in ("copied", "combined"))
    assert float(copied) > float(combined)


def test_noisy_scans_of_one_place_are_combined(standing: LidarRecording) -> None:
    chosen, figures = choose_copying(standing)
    assert not is_copied(chosen.evidence)
    assert figures["stationary_shows"] == "combined"


def test_without_a_validation_scan_at_rest_nothing_is_compared(standing: LidarRecording) -> None:
    left_out = standing.evidence.left_out
    assert left_out is not None
    elsewhere = replace(left_out, validation=np.array([999]))
    lidar = replace(standing, evidence=replace(standing.evidence, left_out=elsewhere))
    chosen, figures = choose_copying(lidar)
    assert chosen is lidar
    assert figures == {}


def test_the_choice_is_stored_with_the_evidence(standing: LidarRecording, tmp_path: Path) -> None:
    chosen, _ = choose_copying(with_scans_like_their_neighbours(standing))
    stored = tmp_path / "evidence.npz"
    np.savez(stored, **chosen.evidence.to_arrays())
    with np.load(stored, allow_pickle=False) as arrays:
        assert is_copied(SceneEvidence.from_arrays(dict(arrays)))
