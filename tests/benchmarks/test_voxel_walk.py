"""The walk's figures are of a scene that was proven, with the error beside the speed."""

import json

from benchmarks.kernels.voxel_walk import measure
from benchmarks.tables.results_table import WALK_RESULTS, walk_table
from nvsf_core.recipe.presets import preset
from tests.stages.lidar_drive import proven_drive


def test_a_proven_scene_gives_a_line_with_and_one_without_shapes(tmp_path):
    run = proven_drive(tmp_path / "run", preset("smoke"), firings=300, held_out=(4,))
    rows = measure(run.store)
    assert [(row["scene"], row["surfaces"]) for row in rows] == [
        ("proven", "with shapes"), ("proven", "without"),
    ]  # fmt: skip
    for row in rows:
        assert min(row[f"{name}_rays_s"] for name in ("build", "list", "answer")) > 0
        assert 0 < row["median_error_m"] < 0.5 and row["voxels"] > 1000
    assert walk_table(tmp_path) == ""
    target = tmp_path / WALK_RESULTS
    target.parent.mkdir(parents=True)
    target.write_text(json.dumps({"machine": "this one", "commit": "abc", "rows": rows}))
    table = walk_table(tmp_path)
    assert "Machine: this one. Commit abc." in table
    assert f"| `proven` | without | 0.20 | {rows[1]['voxels']:,} | " in table
