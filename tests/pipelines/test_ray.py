"""The job on a Ray cluster of this machine: a head and a second worker, each with one core."""

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.cli]
PORT = 6391


@pytest.fixture
def cluster(tmp_path: Path, repo: Path) -> Iterator[str]:
    """Address of a cluster of two nodes; it is stopped after the test."""
    pytest.importorskip("dagster_ray", reason="the extra `ray` is not installed: pip install -e '.[ray]'")
    ray = pytest.importorskip("ray.cluster_utils", reason="the extra `ray` is not installed")
    head = {"num_cpus": 1, "gcs_server_port": PORT, "include_dashboard": True, "dashboard_port": PORT + 1}
    nodes = ray.Cluster(initialize_head=True, head_node_args=head)
    nodes.add_node(num_cpus=1)
    nodes.wait_for_nodes()
    yield nodes.address
    nodes.shutdown()


def test_every_step_runs_on_ray_and_the_data_sets_are_there(
    cluster: str, run_process, tiny_catalogue: Path, tmp_path: Path, repo: Path
) -> None:
    dagster_home = tmp_path / "home" / "dagster"
    dagster_home.mkdir(parents=True)
    shutil.copy(repo / "pipelines" / "dagster.yaml", dagster_home)
    done: subprocess.CompletedProcess[str] = run_process(
        "dagster", "job", "execute", "-j", "train_all_scenes", timeout_s=900.0,
        DAGSTER_MODULE_NAME="pipelines.definitions", NVSF_EXECUTOR="ray", RAY_ADDRESS=cluster,
        NVSF_SCENES=str(tiny_catalogue), NVSF_HOME=str(tmp_path / "home"), DAGSTER_HOME=str(dagster_home),
        PYTHONPATH=str(repo),
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert list((tmp_path / "home/tiny/dataset/shift_1m").glob("*/manifest.json"))
