"""Docstrings describe the arguments of wide functions; no prose uses a word that the project retired."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

FOLDERS = ("nvsf_core", "assets", "pipelines", "benchmarks")
DESCRIBED_FROM = 5
MOST_PARAMETERS = 7
REASON = "# Wide:"
RETIRED = re.compile(
    r"\b(judg\w+|votes?|voted|silent|told|heard|stands still|what stays|standing|answered|answers"
    r"|(?:a|one|the|each|every|per|of) turns?)\b"
)
"""What stands between backticks is a name, and waits for its version."""


def _files(repo: Path, *folders: str) -> list[Path]:
    return [path for folder in folders for path in sorted((repo / folder).rglob("*.py"))]


def _public_functions(path: Path) -> Iterator[ast.FunctionDef]:
    for node in ast.parse(path.read_text()).body:
        for one in (node, *(node.body if isinstance(node, ast.ClassDef) else ())):
            if isinstance(one, ast.FunctionDef) and not one.name.startswith("_") and node.name[0] != "_":
                yield one


def _parameters(function: ast.FunctionDef) -> list[str]:
    arguments = function.args
    names = [one.arg for one in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return [name for name in names if name not in ("self", "cls")]


def test_functions_of_five_or_more_parameters_describe_each(repo):
    missing = []
    for path in _files(repo, *FOLDERS):
        for function in _public_functions(path):
            names = _parameters(function)
            described = (ast.get_docstring(function) or "").partition("Args:")[2]
            lacking = [name for name in names if not re.search(rf"\b{name.strip('_')}\b[^\n]*:", described)]
            if len(names) >= DESCRIBED_FROM and lacking:
                missing.append(
                    f"{path.relative_to(repo)}:{function.lineno} {function.name}: {', '.join(lacking)}"
                )
    assert not missing, "\n".join(missing)


def test_functions_of_more_than_seven_parameters_give_a_reason_above_them(repo):
    wide = []
    for path in _files(repo, *FOLDERS):
        lines = path.read_text().splitlines()
        for function in _public_functions(path):
            first = min([function.lineno, *(one.lineno for one in function.decorator_list)])
            reasons = [line for line in lines[max(0, first - 4) : first - 1] if line.startswith(REASON)]
            if len(_parameters(function)) > MOST_PARAMETERS and not reasons:
                wide.append(f"{path.relative_to(repo)}:{function.lineno} {function.name}")
    assert not wide, "\n".join(wide)


@pytest.mark.parametrize("folder", FOLDERS)
def test_docstrings_and_messages_use_no_retired_word(repo, folder):
    found = []
    for path in _files(repo, folder):
        for node in ast.walk(ast.parse(path.read_text())):
            # What has a blank is prose: descriptions, messages and units that users read.
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
                prose = re.sub(r"`[^`]*`", "", node.value)
                words = [one.group() for one in RETIRED.finditer(prose)]
                found += [f"{path.relative_to(repo)}:{node.lineno} {word}" for word in words]
    assert not found, f"{len(found)}:\n" + "\n".join(found)
