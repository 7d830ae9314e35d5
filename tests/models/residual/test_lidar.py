"""A LiDAR field that learned nothing good is not shown: left-out scans say so, through the real stages."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.evidence.surfels import build_surfels
from nvsf_core.models.baselines.reproject import reprojection
from nvsf_core.models.residual.family import make_fields
from nvsf_core.models.residual.lidar import SHOWS_FIELD, choose, training_for
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.residual import FieldSpec, LossWeights, PanoSpec, ResidualRecipe, TrainingSpec
from nvsf_core.recording.drive import LidarRecording, Recording
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.stages import run_named_stage
from nvsf_core.stages.field import load_trained
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.stage import Outcome
from nvsf_core.stores.checkpoints import load_tensors, save_tensors
from tests.stages.lidar_drive import FRAMES, proven_drive

HELD_OUT = 4
SMOKE = preset("smoke")
assert isinstance(SMOKE, ResidualRecipe)
# Paid for expecting a return where there was none, and none where there was one.
BROKEN = replace(
    SMOKE,
    lidar_field=FieldSpec(levels=2, log2_table=8),
    lidar_training=TrainingSpec(steps=40, rays=512),
    losses=LossWeights(hit=-5.0),
    pano=PanoSpec(phases=1, parts=1),
)


@dataclass(frozen=True)
class Judged:
    """A short drive, with scans enough to leave some out, after the stage `field`."""

    outcome: Outcome
    recording: Recording
    lidar: LidarRecording

    def rendered(self, model: SceneModel) -> RenderedRays:
        """Along the held-out scan's own rays."""
        assert model.lidar is not None
        a, part = self.lidar.sweeps.arrays, self.lidar.sweeps.returns_of(HELD_OUT)
        count = part.stop - part.start
        fired_s = np.full(count, a["time_s"][HELD_OUT])
        return model.lidar(a["origin_m"][part], a["direction"][part], np.ones(count, np.float32), fired_s)

    def is_reproject(self, model: SceneModel) -> bool:
        """Whether every answer is the baseline's."""
        one, other = self.rendered(model), self.rendered(reprojection(self.recording))
        return all(
            np.array_equal(getattr(one, name), getattr(other, name))
            for name in ("range_m", "hit", "intensity")
        )


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> Judged:
    """Its field was broken on purpose."""
    run = proven_drive(tmp_path_factory.mktemp("judged"), BROKEN, firings=500, held_out=(HELD_OUT,))
    outcome = run_named_stage("field", run, lambda line: None)
    recording = read_recording(run.store)
    assert recording.lidar is not None
    return Judged(outcome, recording, recording.lidar)


def test_few_rays_are_not_learned_by_heart() -> None:
    quick, lean = preset("quick"), preset("lean")
    assert isinstance(quick, ResidualRecipe) and isinstance(lean, ResidualRecipe)
    for recipe in (quick, lean):
        assert {training_for(recipe, rays) for rays in (3_302_384, 3_610_591)} == {recipe.lidar_training}
        assert training_for(recipe, 1).steps == 1
    half = training_for(lean, 1_800_000)
    assert half.rays == 4096 and 850 < half.steps < 2.8 * 1_800_000 / 4096
    assert training_for(quick, 1_800_000) == quick.lidar_training


@pytest.mark.parametrize(("rays", "steps", "a_step"), [(98_304, 240, 1024), (500_000, 850, 1472)])
def test_few_rays_make_smaller_steps_rather_than_fewer(rays: int, steps: int, a_step: int) -> None:
    for name in ("quick", "lean"):
        recipe = preset(name)
        assert isinstance(recipe, ResidualRecipe)
        found = training_for(recipe, rays)
        assert (found.steps, found.rays) == (steps, a_step)
        assert found.rays % found.parts == 0
        assert found.steps * found.rays == pytest.approx(2.5 * rays, rel=0.01)
    smoke = preset("smoke")
    assert isinstance(smoke, ResidualRecipe) and training_for(smoke, 98_304) == smoke.lidar_training


def test_a_field_that_does_not_beat_reproject_is_replaced_by_it_and_that_is_said(broken: Judged) -> None:
    said = broken.outcome.metadata
    assert said["lidar_shows"] == "reproject: learning did not beat it"
    assert float(said["lidar_judged_hit_accuracy"]) < float(said["lidar_judged_reproject_hit_accuracy"])
    assert float(said["lidar_judged_chamfer_m2"]) > float(said["lidar_judged_reproject_chamfer_m2"])
    model = load_trained(broken.outcome.path, broken.recording)
    assert broken.is_reproject(model)
    assert model.pano is None, "the baseline's pano is the projection of its scan"


def test_a_field_that_won_is_shown(broken: Judged, tmp_path: Path) -> None:
    tensors, facts = load_tensors(broken.outcome.path / "weights.safetensors")
    assert facts[SHOWS_FIELD] is False
    save_tensors(tmp_path / "weights.safetensors", tensors, facts | {SHOWS_FIELD: True})
    shutil.copy(broken.outcome.path / "recipe.json", tmp_path)
    model = load_trained(tmp_path, broken.recording)
    assert model.pano is not None
    assert not broken.is_reproject(model)


def test_a_field_wins_where_the_baseline_knows_less(broken: Judged) -> None:
    field = make_fields(BROKEN, broken.recording, 0).lidar
    evidence, a = broken.lidar.evidence, broken.lidar.sweeps.arrays
    assert field is not None and evidence.left_out is not None
    first = broken.lidar.sweeps.returns_of(0)
    one_scan = build_surfels(
        a["origin_m"][first], a["direction"][first], a["range_m"][first], a["intensity"][first],
        voxel_m=0.3,
    )  # fmt: skip
    left_out = replace(evidence.left_out, rendered=one_scan)
    poor = replace(broken.lidar, evidence=replace(evidence, left_out=left_out))
    shows_field, said = choose(field, BROKEN, poor)
    assert shows_field and said["lidar_shows"] == "field"
    assert float(said["lidar_judged_chamfer_m2"]) < float(said["lidar_judged_reproject_chamfer_m2"])


def test_judges_are_not_trained_on_and_what_judges_is_proven_without_them(broken: Judged) -> None:
    evidence, sweeps = broken.lidar.evidence, broken.lidar.sweeps
    assert evidence.left_out is not None and len(evidence.left_out.validation) == 2
    training = np.flatnonzero(sweeps.is_training)
    others = [int(scan) for scan in np.delete(training, evidence.left_out.validation)]
    assert HELD_OUT not in training and len(others) == FRAMES - 3
    seen = ~sweeps.arrays["is_own_vehicle"]
    returns = sum(int(seen[sweeps.returns_of(scan)].sum()) for scan in others)
    drops = sum(
        int((~evidence.prior.is_hit[number][evidence.lasers]).sum())
        for number in np.delete(np.arange(len(training)), evidence.left_out.validation)
    )
    assert returns < int(broken.outcome.metadata["training_rays"]) <= returns + drops
    assert int(evidence.left_out.static.hits.sum()) <= returns < int(evidence.static.hits.sum())


def test_a_drive_of_few_scans_is_not_judged_and_shows_the_field(broken: Judged) -> None:
    field = make_fields(BROKEN, broken.recording, 0).lidar
    assert field is not None
    few = replace(broken.lidar, evidence=replace(broken.lidar.evidence, left_out=None))
    assert choose(field, BROKEN, few) == (True, {"lidar_shows": "field: too few scans to compare it on"})
