"""The network of hits is kept where left-out scans say that it helps, and nowhere else."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.recipe import FieldSpec, HitsSpec, LossWeights, ResidualRecipe, TrainingSpec, preset
from nvsf_core.stages.flow import SceneRun
from nvsf_core.stages.recording import LidarRecording, Recording, read_recording
from nvsf_core.stages.residual_hits import TrainedHits, recorded_turns, train_hits
from nvsf_core.stages.residual_model import make_fields
from nvsf_core.stages.stage import Task
from tests.stages.lidar_drive import proven_drive

SMOKE = preset("smoke")
assert isinstance(SMOKE, ResidualRecipe)
SMALL = replace(
    SMOKE,
    lidar_field=FieldSpec(levels=2, log2_table=8),
    hits=HitsSpec(
        channels=8, layers=1, training=TrainingSpec(steps=150, rays=2000, network_rate=1e-2, threads=1)
    ),
)


@dataclass(frozen=True)
class Drive:
    """What the network of hits is trained with; the field was never trained and is the evidence itself."""

    run: SceneRun
    recording: Recording
    lidar: LidarRecording

    def train(self, recipe: ResidualRecipe, work: Path, lidar: LidarRecording) -> TrainedHits:
        """A new network."""
        work.mkdir()
        fields = make_fields(recipe, self.recording, 0)
        assert isinstance(fields.lidar, LidarField) and fields.hits is not None
        run = self.run
        task = Task(
            scene=run.scene, store=run.store, config=run.config, folder=work, progress=lambda _: None
        )
        torch.set_num_threads(1)
        return train_hits(task, work, fields.hits, fields.lidar, recipe, lidar)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    run = proven_drive(tmp_path_factory.mktemp("hits"), SMALL, firings=300, held_out=(4,))
    recording = read_recording(run.store)
    assert recording.lidar is not None
    return Drive(run, recording, recording.lidar)


def test_what_helps_on_left_out_scans_is_kept(drive: Drive, tmp_path: Path) -> None:
    found = drive.train(SMALL, tmp_path / "work", drive.lidar)
    said = found.metadata
    helps = float(said["hits_judged_accuracy"]) > float(said["hits_judged_ray_head_accuracy"])
    assert helps and found.correct is not None and said["hits_shown"] == "network and ray head"


def test_what_learned_the_contrary_is_not_used_and_that_is_said(drive: Drive, tmp_path: Path) -> None:
    found = drive.train(replace(SMALL, losses=LossWeights(hit=-5.0)), tmp_path / "work", drive.lidar)
    said = found.metadata
    assert float(said["hits_judged_accuracy"]) < float(said["hits_judged_ray_head_accuracy"])
    assert found.correct is None and said["hits_shown"] == "ray head: learning did not beat it"


def test_without_scans_that_judge_nothing_is_learned(drive: Drive, tmp_path: Path) -> None:
    unjudged = replace(drive.lidar, evidence=replace(drive.lidar.evidence, left_out=None))
    found = drive.train(SMALL, tmp_path / "work", unjudged)
    assert found.correct is None and not found.states
    assert found.metadata == {"hits_shown": "ray head: too few scans to judge a network by"}


def test_a_scan_of_which_no_laser_is_known_teaches_no_drops(drive: Drive, tmp_path: Path) -> None:
    evidence = drive.lidar.evidence
    is_hit = evidence.prior.is_hit.copy()
    is_hit[3] = False
    unknown = replace(evidence, prior=replace(evidence.prior, is_hit=is_hit))
    accuracy = [
        float(drive.train(SMALL, tmp_path / name, lidar).metadata["hits_judged_accuracy"])
        for name, lidar in (("all", drive.lidar), ("unknown", replace(drive.lidar, evidence=unknown)))
    ]
    assert accuracy[1] > accuracy[0] - 0.01


def test_recorded_turns_hold_every_training_return_where_the_prior_has_it(drive: Drive) -> None:
    turns, prior = recorded_turns(drive.lidar), drive.lidar.evidence.prior
    assert np.array_equal(turns.range_m > 0.0, prior.is_hit)
    sweeps = drive.lidar.sweeps
    first = sweeps.returns_of(int(np.flatnonzero(sweeps.is_training)[0]))
    recorded = sweeps.arrays["range_m"][first]
    assert np.array_equal(np.sort(turns.range_m[0][prior.is_hit[0]]), np.sort(recorded))
