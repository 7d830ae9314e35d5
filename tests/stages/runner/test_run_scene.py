"""The flow without Dagster: in order, skipped when unchanged, one training a device."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.errors import DataError, RecipeError, StoreError
from nvsf_core.recipe.presets import preset
from nvsf_core.stages import STAGE_NAMES, plan_run, run_named_stage, run_scene
from nvsf_core.stages.runner.locks import device_lock
from nvsf_core.stages.runner.stage import Stage, StageOutput
from nvsf_core.stages.runner.trained import newest_field

OPEN3D_LIBRARIES = ("libEGL.so.1", "libGL.so.1", "libX11.so.6")
BARE_RUN = """
import json, sys
sys.modules["dagster"] = None
from nvsf_core.stages import run_scene
from nvsf_core.stages.checks.registration import registration_check
from tests.stages.checks.test_registration import street
outcomes = run_scene("tiny", progress=lambda line: None)
print(registration_check(street(0.0)).detail)
print(next(outcome.metadata["mesh"] for outcome in outcomes if outcome.stage == "mesh"))
print(json.dumps([[outcome.stage, outcome.skipped, outcome.path.is_dir()] for outcome in outcomes]))
"""

LEASE_HOLDER = """
import sys, time
from pathlib import Path
from nvsf_core.stages.runner.locks import device_lock
with device_lock(Path(sys.argv[1]), print):
    Path(sys.argv[1], "held").write_text("")
    time.sleep(60)
"""


def _make(name, inputs, made, group="ingest", content="", **facts):
    def run(task):
        made.append(name)
        for source in inputs:
            task.store.require(source)
        (task.folder / "content").write_text(content or name)
        return StageOutput(metadata={"n": 1})

    return Stage(name=name, group=group, inputs=inputs, description=name, version="1", run=run, **facts)


@pytest.fixture
def entry(tiny_catalogue):
    return next(one for one in load_catalogue([tiny_catalogue], None) if one.name == "tiny")


def test_the_whole_flow_runs_without_dagster_and_the_libraries_that_open3d_links_to(
    run_process, tiny_catalogue, tmp_path
):
    slim = tmp_path / "slim"
    slim.mkdir()
    # An empty file in the loader's way is a library that cannot be loaded.
    for name in OPEN3D_LIBRARIES:
        (slim / name).touch()
    done = run_process(
        sys.executable, "-c", BARE_RUN, NVSF_SCENES=str(tiny_catalogue), NVSF_HOME=str(tmp_path / "home"),
        LD_LIBRARY_PATH=str(slim),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    *said, outcomes = done.stdout.splitlines()
    assert json.loads(outcomes) == [[name, False, True] for name in STAGE_NAMES]
    assert len(said) == 2
    for line in said:
        assert line.startswith("not run: open3d cannot be loaded") and "apt-get install" in line


def test_stages_run_in_order_and_once(entry, tmp_path):
    made = []
    flow = [_make("a", (), made), _make("b", ("a",), made)]
    said = []
    run_scene(entry, tmp_path, progress=said.append, stages=flow)
    second = run_scene(entry, tmp_path, progress=said.append, stages=flow)
    assert made == ["a", "b"] and [outcome.skipped for outcome in second] == [True, True]
    assert "[tiny] b: up to date, skipped" in said


@pytest.mark.parametrize(("content", "again"), [("other", ["a", "b"]), ("a", ["a"])])
def test_a_new_version_of_a_stage_runs_what_reads_it_again_where_its_content_changed(
    entry, tmp_path, content, again
):
    made, said = [], []
    flow = [_make("a", (), made), _make("b", ("a",), made)]
    run_scene(entry, tmp_path, progress=str, stages=flow)
    made.clear()
    flow[0] = replace(_make("a", (), made, content=content), version="2")
    run_scene(entry, tmp_path, progress=said.append, stages=flow)
    assert made == again
    assert "[tiny] a: made again, for the stage's code (version 1, now 2) changed" in said
    assert ("[tiny] b: made again, for its input a changed" in said) == (again == ["a", "b"])


@pytest.mark.parametrize(
    "measured", ["curve.parquet", "a.zarr/train_seconds/c/0", "a.zarr/peak_memory_mb/c/0"]
)
def test_what_an_output_cost_to_make_is_not_what_its_readers_depend_on(entry, tmp_path, measured):
    made = []

    def make(seconds):
        plain = _make("a", (), made)

        def run(task):
            file = task.folder / measured
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(seconds)
            return plain.run(task)

        return replace(plain, run=run, version=seconds)

    for seconds in ("17.25", "18.5"):
        run_scene(entry, tmp_path, progress=str, stages=[make(seconds), _make("b", ("a",), made)])
    assert made == ["a", "b", "a"]


def test_a_stage_alone_needs_its_inputs(entry, tmp_path):
    flow = [_make("a", (), []), _make("b", ("a",), [])]
    with pytest.raises(StoreError, match="no output 'a'"):
        run_named_stage("b", plan_run(entry, tmp_path), str, stages=flow)


def test_two_recipes_lie_side_by_side(entry, tmp_path):
    flow = [_make("field", (), [], per_recipe=True)]
    places = [
        run_scene(entry, tmp_path, recipe=recipe, seed=3, progress=str, stages=flow)[0].path
        for recipe in ("quick", "smoke")
    ]
    assert places == [tmp_path / "tiny/field/quick/3", tmp_path / "tiny/field/smoke/3"]


def test_a_copied_home_has_the_same_newest_field(entry, tmp_path):
    stages = [_make("field", (), [], per_recipe=True)]
    for recipe in ("quick", "lean", "paper_smoke"):
        run_scene(entry, tmp_path, recipe=recipe, progress=str, stages=stages)
    for number, recipe in enumerate(("paper_smoke", "lean", "quick")):
        os.utime(tmp_path / f"tiny/field/{recipe}/0/stage.json", (number, number))
    assert newest_field(tmp_path / "tiny") == ("paper_smoke", 0)


def test_the_recipe_asked_for_goes_before_the_catalogues(entry, tmp_path):
    assert plan_run(entry, tmp_path, recipe="quick").config.recipe == preset("quick")
    assert plan_run(entry, tmp_path).config.recipe == preset("smoke")
    assert plan_run(replace(entry, recipe=None), tmp_path).config.recipe == preset("lean")
    with pytest.raises(RecipeError, match="splendid"):
        plan_run(entry, tmp_path, recipe="splendid")


def test_a_drive_among_its_own_outputs_is_refused_before_a_stage_replaces_it(entry, tmp_path):
    home = tmp_path.resolve()
    for root, kind in (
        (home / "tiny", "plain"),
        (home / "tiny/drive", "kitti360"),
        (home / "tiny", "kitti_raw"),
    ):
        with pytest.raises(StoreError, match=f"one lies in the other.*for example to {home}/drives/tiny"):
            plan_run(replace(entry, root=root, kind=kind), home)
    with pytest.raises(StoreError, match="one lies in the other"):  # the drive's own folder is the scene's
        plan_run(replace(entry, root=home, kind="plain", name="scans"), home)
    # Beside its outputs, or around the whole home, it is not touched.
    for root, place in ((home / "drives/tiny", home), (home / "other", home), (home, home / ".nvsf")):
        assert plan_run(replace(entry, root=root, kind="plain"), place).store.root == place / "tiny"


def test_an_unknown_scene_is_refused_with_the_known_ones(tiny_catalogue, monkeypatch):
    monkeypatch.setenv("NVSF_SCENES", str(tiny_catalogue))
    with pytest.raises(DataError, match=r"no scene 'tinny'.*tiny"):
        run_scene("tinny")


def test_a_second_training_waits_until_the_first_is_killed(tmp_path):
    holder = subprocess.Popen([sys.executable, "-c", LEASE_HOLDER, str(tmp_path)])
    try:
        while not (tmp_path / "held").exists():
            assert holder.poll() is None
            time.sleep(0.02)
        said = []

        def on_wait(line):
            said.append(line)
            os.kill(holder.pid, signal.SIGKILL)

        with device_lock(tmp_path, on_wait) as device:
            assert device and len(said) == 1 and "another training holds it" in said[0]
    finally:
        holder.kill()
        holder.wait()


IN_A_CONTAINER = """
import os
from pathlib import Path
from nvsf_core.stages.runner.locks import lock_file
for device in ("", "0"):
    for executor in ("k8s", "multiprocess"):
        os.environ.update(CUDA_VISIBLE_DEVICES=device, NVSF_EXECUTOR=executor)
        print(lock_file(Path()).name)
"""


def test_each_pod_trains_on_its_own_cpus_and_containers_of_one_machine_share_theirs(run_process):
    container = ("unshare", "--user", "--map-root-user", "--pid", "--fork", sys.executable, "-c")
    if run_process(*container, "").returncode != 0:
        pytest.skip("no container can be made here")
    first, second = (run_process(*container, IN_A_CONTAINER).stdout.splitlines() for _ in range(2))
    assert first[0] != second[0] and first[0].startswith("cpu-"), "two pods"
    assert first[1:] == second[1:] and [name[:4] for name in first] == ["cpu-", "cpu-", "cuda", "cuda"]


def test_only_what_trains_takes_the_device(entry, tmp_path):
    flow = [_make("a", (), []), _make("field", ("a",), [], group="train")]
    run_scene(entry, tmp_path, progress=str, stages=flow[:1])
    assert not list((tmp_path / ".leases").glob("*.lock"))
    run_scene(entry, tmp_path, progress=str, stages=flow)
    assert len(list((tmp_path / ".leases").glob("*.lock"))) == 1
