"""The ablation's tables carry what learns nothing, scored as its variants are."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.common.compared import block_colours
from benchmarks.common.documents import read_rows
from benchmarks.paper.ablation_scoring import IMAGE_STEP, Scene, baseline_rows, score_image
from benchmarks.paper.ablation_table import RESULTS
from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.errors import DataError
from nvsf_core.metrics.table import BASELINES
from nvsf_core.models.paper.scene import training_frames
from nvsf_core.recipe.presets import preset
from nvsf_core.stages import STAGE_NAMES, run_named_stage
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.run import plan_run
from nvsf_core.stages.scoring.moving_boxes import read_moving_boxes


@pytest.fixture(scope="module")
def scene(tiny_catalogue: Path, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    entry = next(entry for entry in load_catalogue([tiny_catalogue], None) if entry.name == "tiny")
    run = plan_run(entry, tmp_path_factory.mktemp("ablation"), recipe="smoke")
    for stage in STAGE_NAMES[: STAGE_NAMES.index("field")]:
        run_named_stage(stage, run, lambda _: None)
    recording = read_recording(run.store)
    frames = training_frames(preset("paper_cpu"), recording)
    return Scene(run=run, recording=recording, frames=frames, boxes=read_moving_boxes(run.store))


def test_baselines_are_scored_from_published_views_and_without_them_it_is_said_how_to_get_some(scene):
    with pytest.raises(DataError, match="make train SCENES=tiny RECIPE=quick"):
        baseline_rows(scene, "reproject")
    for stage in ("mesh", "field", "novel_views"):
        run_named_stage(stage, scene.run, lambda _: None)
    found = {name: baseline_rows(scene, name) for name in ("reproject", "copy_nearest")}
    errors = {
        name: {row["metric"]: row["value"] for row in rows if row["region"] == "all"}
        for name, rows in found.items()
    }
    assert {"chamfer_m2", "hit_rmse", "image_psnr_db"} <= errors["reproject"].keys()
    assert errors["reproject"] != errors["copy_nearest"]
    assert {row["variant"] for row in found["reproject"]} == {"reproject"}


def test_every_scene_on_record_has_all_baselines():
    rows = read_rows(RESULTS)
    for scene in {row["scene"] for row in rows}:
        assert set(BASELINES) <= {row["variant"] for row in rows if row["scene"] == scene}


def test_a_small_image_is_compared_with_the_means_of_the_pixels_it_stands_for():
    truth = np.random.default_rng(0).integers(0, 256, (34, 41, 3), dtype=np.uint8)
    small = block_colours(truth, IMAGE_STEP)
    assert small.shape == (8, 10, 3)
    assert small[0, 0, 0] == round(float(truth[:IMAGE_STEP, :IMAGE_STEP, 0].mean()))
    valid = np.ones(truth.shape[:2], np.bool_)
    valid[0, 0] = False
    other = small.copy()
    other[0, 0] = 255 - other[0, 0]
    # A pixel of which a part was not recorded is not compared.
    assert (
        score_image(other, truth, valid)["image_psnr_db"] == score_image(small, truth, valid)["image_psnr_db"]
    )
