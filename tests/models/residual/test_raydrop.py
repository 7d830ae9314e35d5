"""Networks of a LiDAR's grids: that of hits is kept where left-out scans say that it helps, else not."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.models.residual.family import make_fields
from nvsf_core.models.residual.pano import train_pano
from nvsf_core.models.residual.raydrop import (
    TrainedHits,
    ValidationSweep,
    blend_in_rotation,
    train_hits,
)
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.residual import FieldSpec, HitsSpec, LossWeights, PanoSpec, ResidualRecipe, TrainingSpec
from nvsf_core.recording.drive import LidarRecording, Recording
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.checkpoints import StageSession
from nvsf_core.stages.runner.run import SceneRun
from nvsf_core.stages.runner.stage import Task
from tests.stages.lidar_drive import proven_drive

SMOKE = preset("smoke")
assert isinstance(SMOKE, ResidualRecipe)
SMALL = replace(
    SMOKE,
    lidar_field=FieldSpec(levels=2, log2_table=8),
    hits=HitsSpec(channels=8, layers=1, training=TrainingSpec(steps=150, rays=2000, network_rate=1e-2)),
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
        return train_hits(self.session(work), fields.hits, fields.lidar, recipe, lidar)

    def session(self, work: Path) -> StageSession:
        """Of a training that keeps its checkpoints in `work`."""
        run = self.run
        task = Task(scene=run.scene, store=run.store, config=run.config, folder=work, progress=lambda _: None)
        return StageSession(task, work)


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
    assert float(said["hits_judged_nats"]) < float(said["hits_judged_ray_head_nats"])


def test_a_judge_is_told_by_a_blend_that_never_saw_it() -> None:
    logit, returned = np.array([4.0, 4.0, -4.0, -4.0], np.float32), np.array([True, True, False, False])
    answered = np.ones(4, np.bool_)
    network_is_right = ValidationSweep(logit, -logit, answered, returned)
    ray_head_is_right = ValidationSweep(-logit, logit, answered, returned)
    blend, said = blend_in_rotation([network_is_right, ray_head_is_right])
    assert said["hits_judged_accuracy"] == 0.0, "each would be told right by a blend of its own"
    assert said["hits_judged_ray_head_accuracy"] == 0.5 and blend is None
    blend, said = blend_in_rotation([network_is_right, network_is_right])
    assert said["hits_judged_accuracy"] == 1.0 and blend is not None and blend.ray_head == 0.0


def test_what_learned_the_contrary_has_no_say_in_the_blend(drive: Drive, tmp_path: Path) -> None:
    found = drive.train(replace(SMALL, losses=LossWeights(hit=-5.0)), tmp_path / "work", drive.lidar)
    said = found.metadata
    assert str(said["hits_blend"]).startswith("0.00 network"), "what is left is the ray head, calibrated"
    helps = float(said["hits_judged_accuracy"]) > float(said["hits_judged_ray_head_accuracy"])
    assert (found.correct is not None) == helps
    assert (said["hits_shown"] == "ray head: learning did not beat it") == (not helps)


def test_without_scans_that_judge_nothing_is_learned(drive: Drive, tmp_path: Path) -> None:
    unjudged = replace(drive.lidar, evidence=replace(drive.lidar.evidence, left_out=None))
    found = drive.train(SMALL, tmp_path / "work", unjudged)
    assert found.correct is None and not found.states
    assert found.metadata == {"hits_shown": "ray head: too few scans to compare a network on"}


def test_a_scan_of_which_no_laser_is_known_teaches_no_drops(drive: Drive, tmp_path: Path) -> None:
    evidence = drive.lidar.evidence
    is_hit = evidence.prior.is_hit.copy()
    is_hit[3] = False
    unobserved = replace(evidence, prior=replace(evidence.prior, is_hit=is_hit))
    accuracy = [
        float(drive.train(SMALL, tmp_path / name, lidar).metadata["hits_judged_accuracy"])
        for name, lidar in (("all", drive.lidar), ("unknown", replace(drive.lidar, evidence=unobserved)))
    ]
    assert accuracy[1] > accuracy[0] - 0.01


def test_recorded_turns_hold_every_training_return_where_the_prior_has_it(drive: Drive) -> None:
    scan_grids, prior = drive.lidar.scan_grids, drive.lidar.evidence.prior
    assert np.array_equal(scan_grids.range_m > 0.0, prior.is_hit)
    sweeps = drive.lidar.sweeps
    first = sweeps.returns_of(int(np.flatnonzero(sweeps.is_training)[0]))
    recorded = sweeps.arrays["range_m"][first]
    assert np.array_equal(np.sort(scan_grids.range_m[0][prior.is_hit[0]]), np.sort(recorded))


def test_the_seconds_of_training_a_pano_are_all_that_it_took(drive: Drive, tmp_path: Path) -> None:
    once = TrainingSpec(steps=1, rays=264)
    pano = PanoSpec(phases=1, parts=2, channels=32, layers=4, frames=3, judge_every=2, training=once)
    recipe = replace(SMALL, pano=pano)
    fields = make_fields(recipe, drive.recording, 0)
    assert fields.lidar is not None and fields.pano is not None
    session, started = drive.session(tmp_path), time.perf_counter()
    trained = train_pano(session, fields.pano, fields.lidar, recipe, drive.lidar, None)
    took_s = time.perf_counter() - started
    counted_s = trained.preparation_seconds + sum(state.seconds for state in trained.states.values())
    assert 0.85 * took_s < counted_s <= took_s
