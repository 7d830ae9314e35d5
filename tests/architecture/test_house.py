"""The house keeps its own rules."""

import ast
import importlib
import itertools
import re
import sys
import tomllib
from collections import Counter
from pathlib import Path

import pytest

from nvsf_core.stages import STAGES

PACKAGES = ("nvsf_core", "assets", "pipelines")
OURS = (*PACKAGES, "benchmarks")


def _sources(repo: Path, *folders: str) -> list[Path]:
    return [path for folder in folders for path in sorted((repo / folder).rglob("*.py"))]


def test_import_contracts_hold(run_process):
    done = run_process("lint-imports", "--no-cache")
    assert done.returncode == 0, done.stdout + done.stderr


_HEAVY = ("torch", "open3d", "cv2", "zarr", "pyarrow", "matplotlib", "numba", "scipy.spatial")


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        *((name, (*_HEAVY, "dagster")) for name in ("nvsf_core", "nvsf_core.stages", "nvsf_core.geometry")),
        # Dagster's command, its code server and its daemon each import the definitions before they answer.
        ("pipelines.definitions", _HEAVY),
    ],
)
def test_importing_loads_no_heavy_library(run_process, module, absent):
    code = f"import sys, {module}; print(sorted({set(absent)} & set(sys.modules)))"
    done = run_process(sys.executable, "-c", code)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


def test_each_stage_finds_its_work():
    later = [(one.run, one.check, one.estimate_bytes, one.tidy) for one in STAGES]
    assert all(callable(work.load()) for works in later for work in works if work is not None)


def test_no_core_module_mentions_dagster_in_an_import(repo):
    pattern = re.compile(r"^\s*(from|import) dagster", re.MULTILINE)
    assert [path for path in _sources(repo, "nvsf_core") if pattern.search(path.read_text())] == []


def test_no_postponed_annotations_where_dagster_reads_them(repo):
    # Dagster resolves `config: Choice` at definition time and fails on a string.
    sources = _sources(repo, "assets", "pipelines")
    assert [path for path in sources if "from __future__ import annotations" in path.read_text()] == []


def test_every_name_that_is_imported_of_ours_is_there(repo):
    # Commands that no test runs, as most benchmarks, would else fail only where somebody needs them.
    trees = {
        path: ast.parse(path.read_text()) for path in _sources(repo, *PACKAGES, "benchmarks", "examples")
    }
    modules = {".".join(path.relative_to(repo).with_suffix("").parts): tree for path, tree in trees.items()}
    names = {name.removesuffix(".__init__"): _bound(tree) for name, tree in modules.items()}
    for name in list(names):
        names.setdefault(name.rpartition(".")[0], set()).add(name.rpartition(".")[2])
    absent = [
        f"{path.relative_to(repo)}: {node.module}.{one.name}"
        for path, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in OURS
        for one in node.names
        if one.name not in names.get(node.module, set())
    ]
    assert absent == []


def _bound(tree: ast.Module) -> set[str]:
    """Names that a module binds by imports, classes and functions at its top, and by assignments anywhere."""
    names = [one for one in ast.walk(tree) if isinstance(one, ast.Name)]
    assigned = {one.id for one in names if isinstance(one.ctx, ast.Store)}
    imported = {one.asname or one.name for node in tree.body for one in getattr(node, "names", [])}
    return assigned | imported | {node.name for node in tree.body if hasattr(node, "name")}


def test_no_source_file_is_longer_than_400_lines(repo):
    sources = _sources(repo, *PACKAGES, "tests", "benchmarks")
    assert [path for path in sources if len(path.read_text().splitlines()) > 400] == []


def test_no_folder_holds_more_than_22_files(repo):
    sources = _sources(repo, *PACKAGES, "tests", "benchmarks", "examples")
    counts = Counter(path.parent.relative_to(repo).as_posix() for path in sources)
    assert {folder: count for folder, count in counts.items() if count > 22} == {}


def test_readme_is_at_most_150_lines(repo):
    assert len((repo / "README.md").read_text().splitlines()) <= 150


def test_readme_tree_equals_the_disk(repo):
    readme = (repo / "README.md").read_text()
    block = re.search(r"<!-- tree -->\n```\n(.*?)```", readme, re.DOTALL)
    assert block, "README.md: expected a tree between `<!-- tree -->` and the end of its code block"
    named = {line.split()[0] for line in block.group(1).splitlines()}
    tops = {"assets", "benchmarks", "deploy", "docs", "examples", "nvsf_core", "pipelines", "tests"}
    core = {f"nvsf_core/{path.name}" for path in (repo / "nvsf_core").iterdir() if _is_shown(path)}
    assert named == {f"{name}/" for name in tops} | {f"{name}/" if "." not in name else name for name in core}
    missing = sorted(name for name in tops if not (repo / name).is_dir())
    assert missing == []


def _is_shown(path: Path) -> bool:
    return path.suffix != ".typed" and path.name != "__init__.py" and not path.name.startswith((".", "__"))


def test_every_dependency_says_why(repo):
    text = (repo / "pyproject.toml").read_text()
    listed = text.split("dependencies = [", 1)[1].split("\n]\n", 1)[0].splitlines()
    for above, line in itertools.pairwise(listed):
        if line.strip().startswith('"'):
            assert "#" in line or above.strip().startswith("#"), f"no reason for {line.strip()}"


def test_every_dependency_beyond_the_users_list_has_a_decision(repo):
    titles = [path.read_text().splitlines()[0] for path in (repo / "docs/decisions").glob("*.md")]
    for name in ("numba", "defusedxml", "safetensors", "matplotlib", "libusb-package"):
        assert any(name in title for title in titles), name


def test_project_and_workspace_name_the_same_location(repo):
    project = tomllib.loads((repo / "pyproject.toml").read_text())["tool"]["dg"]["project"]
    workspace = (repo / "workspace.yaml").read_text()
    assert f"module_name: {project['code_location_target_module']}" in workspace
    assert f"location_name: {project['code_location_name']}" in workspace


@pytest.mark.parametrize("module", ["nvsf_core.stages", "nvsf_core.errors"])
def test_public_names_exist_and_are_sorted(module):
    loaded = importlib.import_module(module)
    assert [name for name in loaded.__all__ if not hasattr(loaded, name)] == []
    # Constants, then classes, then functions, each by name: the order that ruff keeps.
    order = sorted(loaded.__all__, key=lambda name: (not name.isupper(), name[0].islower(), name))
    assert loaded.__all__ == order


def test_ci_runs_check_and_test(repo):
    script = repo / ".ci/run"
    assert script.stat().st_mode & 0o111
    assert script.read_text().index("make check") < script.read_text().index("make test")
