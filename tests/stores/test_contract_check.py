"""What breaks the data contract is not published."""

from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.errors import NoDataError, StoreError
from nvsf_core.stages import Stage, plan_run, run_named_stage
from nvsf_core.stages.runner.stage import StageOutput, Task
from nvsf_core.stores.arrays import write_arrays
from nvsf_core.stores.contract_check import contract_faults
from nvsf_core.stores.tables import write_table


def _stage(name: str, run) -> Stage:
    return Stage(name=name, group="ingest", inputs=(), description="broken", version="1", run=run)


def _pano_of_doubles(task: Task) -> StageOutput:
    write_arrays(task.folder / "pano.zarr", {"frame": np.zeros(2), "linear_range_m": np.zeros((2, 3))})
    return StageOutput()


def _frames_of_one_column(task: Task) -> StageOutput:
    write_table(task.folder / "frames.parquet", {"frame": ["first"]})
    return StageOutput()


@pytest.mark.parametrize(
    ("name", "make", "word"),
    [
        ("pano", _pano_of_doubles, "pano.zarr: frame: expected type i8, found f8"),
        ("frames", _frames_of_one_column, "column frame: expected i8, found string"),
    ],
)
def test_what_breaks_the_contract_is_refused_and_not_published(tiny_catalogue, tmp_path, name, make, word):
    run = plan_run(load_catalogue([tiny_catalogue], None)[0], tmp_path)
    with pytest.raises(StoreError) as refused:
        run_named_stage(name, run, lambda _: None, stages=[_stage(name, make)])
    faults = "; ".join(contract_faults(name, name, _again(tmp_path / "again", make)))
    assert "not published" in str(refused.value) and word in faults
    assert not (run.store.root / name).exists()


def _again(folder: Path, make) -> Path:
    folder.mkdir()
    make(Task(scene=None, store=None, config=None, folder=folder, progress=lambda _: None))
    return folder


def test_a_sensor_that_is_absent_breaks_nothing(tmp_path):
    write_arrays(tmp_path / "returns.zarr", {})
    assert contract_faults("sweeps", "sweeps", tmp_path) == []


def test_a_drive_that_is_not_on_this_machine_is_named(tiny_catalogue, tmp_path):
    absent = next(entry for entry in load_catalogue([tiny_catalogue], None) if entry.name == "absent")
    with pytest.raises(NoDataError, match="scene absent: expected scans or images of frames 0 to 3"):
        run_named_stage("frames", plan_run(absent, tmp_path), lambda _: None)
