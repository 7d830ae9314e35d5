"""What is deployed names what is there: one location, the instance's own settings, files that exist."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"


def _read(path: Path):
    return yaml.safe_load(path.read_text())


def test_the_instance_of_containers_differs_from_the_template_by_its_storage_alone(repo: Path) -> None:
    ours, template = _read(DEPLOY / "dagster.yaml"), _read(repo / "pipelines/dagster.yaml")
    assert ours.pop("storage").keys() == {"postgres"}
    assert ours == template


def test_every_place_names_the_same_code_location(repo: Path) -> None:
    (server,) = _read(DEPLOY / "workspace.yaml")["load_from"]
    (module,) = _read(repo / "workspace.yaml")["load_from"]
    assert server["grpc_server"]["location_name"] == module["python_module"]["location_name"]
    name = module["python_module"]["module_name"]
    assert f'"-m", "{name}"' in (DEPLOY / "Dockerfile").read_text()
    (deployed,) = _read(DEPLOY / "helm-values.yaml")["dagster-user-deployments"]["deployments"]
    assert deployed["dagsterApiGrpcArgs"] == ["-m", name]


def test_the_image_copies_what_exists_and_what_is_not_ignored(repo: Path) -> None:
    allowed = {line[1:] for line in (repo / ".dockerignore").read_text().splitlines() if line[:1] == "!"}
    copied = re.findall(r"^COPY (.*) \S+$", (DEPLOY / "Dockerfile").read_text(), re.MULTILINE)
    names = [name for line in copied for name in line.split()]
    assert names and all((repo / name).exists() and name.split("/")[0] in allowed for name in names)


def test_every_place_waits_ten_minutes_for_a_busy_code_location(repo: Path) -> None:
    name, seconds = "DAGSTER_GRPC_TIMEOUT_SECONDS", "600"
    assert f"{name}={seconds} $(BIN)/dagster dev" in (repo / "Makefile").read_text()
    services, values = _read(DEPLOY / "compose.yaml")["services"], _read(DEPLOY / "helm-values.yaml")
    assert [services[one]["environment"][name] for one in ("daemon", "webserver")] == [seconds] * 2
    patience = [{"name": name, "value": seconds}]
    assert [values[one]["env"] for one in ("dagsterDaemon", "dagsterWebserver")] == [patience] * 2
    template = _read(repo / "pipelines/dagster.yaml")
    starts = (
        template["run_monitoring"]["start_timeout_seconds"],
        template["code_servers"]["local_startup_timeout"],
    )
    assert starts == (int(seconds), int(seconds))
    assert values["dagsterDaemon"]["runMonitoring"]["startTimeoutSeconds"] == int(seconds)


def test_compose_is_accepted_by_its_own_tool() -> None:
    tool = shutil.which("docker-compose")
    command = [tool] if tool else ["docker", "compose"]
    if not tool and (shutil.which("docker") is None or _fails([*command, "version"])):
        pytest.skip("neither docker-compose nor docker's plugin compose is installed")
    environment = os.environ | {"NVSF_DB_PASSWORD": "secret"}
    assert not _fails([*command, "-f", str(DEPLOY / "compose.yaml"), "config", "-q"], environment)
    assert _fails([*command, "-f", str(DEPLOY / "compose.yaml"), "config", "-q"]), "a password is asked for"


def test_every_container_has_all_variables_that_the_readme_lists_and_the_logs_of_steps(repo: Path) -> None:
    rows = re.findall(r"^\| (`[A-Z].*?) \|", (repo / "README.md").read_text(), re.MULTILINE)
    listed = {name for row in rows for name in re.findall(r"`([A-Z][A-Z0-9_]+)`", row)}
    image = (DEPLOY / "Dockerfile").read_text()
    set_there = {name for name in listed if f"{name}=/" in image}
    assert set_there == {"NVSF_HOME", "NVSF_KITTI360_ROOT", "DAGSTER_HOME"} and "NVSF_SCENES" in listed
    for name in ("worker", "daemon", "webserver"):
        service = _read(DEPLOY / "compose.yaml")["services"][name]
        lacks = [one for one in listed - set_there if service["environment"].get(one) != f"${{{one}:-}}"]
        assert lacks == [], name
        assert "logs:/opt/dagster/storage" in service["volumes"] and "/opt/dagster/storage " in image


def test_a_worker_that_is_made_anew_knows_the_runs_of_the_old_one_by_its_host_name() -> None:
    services = _read(DEPLOY / "compose.yaml")["services"]
    assert services["worker"].get("hostname") == "worker", "else a container's id, another one each time"


def _fails(command: list[str], environment: dict[str, str] | None = None) -> bool:
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    return done.returncode != 0


def test_what_pods_are_told_exists(repo: Path) -> None:
    documented = (repo / "README.md").read_text()
    (deployed,) = _read(DEPLOY / "helm-values.yaml")["dagster-user-deployments"]["deployments"]
    assert [one["name"] for one in deployed["env"] if f"`{one['name']}`" not in documented] == []
    mounts = {mount["name"] for mount in deployed["volumeMounts"]}
    assert mounts == {volume["name"] for volume in deployed["volumes"]}
