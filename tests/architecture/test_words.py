"""One word a thing: retired words are refused in public names and in headings (docs/glossary.md)."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

RETIRED = {
    "turn": "sweep", "turns": "sweeps", "standing": "static or above_ground", "stays": "static",
    "still": "static", "background": "static", "judge": "validation", "judges": "validation",
    "judged": "validation", "silent": "validation", "told": "validation", "heard": "validation",
    "answer": "return or render", "answers": "RenderedRays", "answered": "return", "law": "check",
    "laws": "checks", "lease": "device lock", "vote": "hit_prior", "votes": "hit_prior",
    "slips": "reference_quirks", "draw": "sample", "draws": "samples", "drawn": "sampled",
    "thing": "moving object", "things": "moving objects",
}  # fmt: skip
STORED = {"votes", "slips", "judge_every", "draw_seed", "per_draw"}
"""Names that recipes, runs and stages are stored with: they wait for a version."""
ROTATION = re.compile(
    r"turn_(deg|rad|up|up_rad|down_rad|to_object)|free_turns|MOST_TURN_DEG|firings_per_turn"
)
"""Here a turn is an angle, or the revolution that a sensor's maker means."""
FOLDERS = ("nvsf_core", "assets", "pipelines")


def _words(name: str) -> list[str]:
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().split("_")


def _public_names(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield node.name
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield from (one.arg for one in (*node.args.args, *node.args.kwonlyargs))
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            yield node.target.id
    for node in tree.body:
        if isinstance(node, ast.Assign):
            yield from (one.id for one in node.targets if isinstance(one, ast.Name))


def _faults(names: Iterator[str]) -> list[str]:
    return [
        f"{name}: instead of {word}, say {RETIRED[word]}"
        for name in dict.fromkeys(names)
        if not name.startswith("_") and name not in STORED and not ROTATION.fullmatch(name)
        for word in _words(name)
        if word in RETIRED
    ]


@pytest.mark.parametrize("folder", FOLDERS)
def test_public_names_hold_no_retired_word(repo: Path, folder: str) -> None:
    found = {
        path.relative_to(repo).as_posix(): faults
        for path in sorted((repo / folder).rglob("*.py"))
        if (faults := _faults(iter([*_public_names(ast.parse(path.read_text())), path.stem])))
    }
    assert found == {}


@pytest.mark.parametrize("name", ["fire_turn", "AnsweredTurn", "unused_vote", "LAWS"])
def test_a_retired_word_would_be_found(name: str) -> None:
    assert _faults(iter([name])) != []


def test_headings_hold_no_retired_word(repo: Path) -> None:
    pages = [repo / "README.md", repo / "CONTRIBUTING.md", *sorted((repo / "docs").rglob("*.md"))]
    headings = [
        line.strip("# ")
        for page in pages
        for line in re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL).splitlines()
        if line.startswith("#")
    ]
    words = RETIRED.keys() - {"draw", "answers", "answer"}
    assert [line for line in headings if words & set(re.findall(r"[a-z]+", line.lower()))] == []


def test_every_retired_word_stands_in_the_glossary(repo: Path) -> None:
    glossary = (repo / "docs/glossary.md").read_text()
    plain = {
        "turns",
        "judges",
        "judged",
        "heard",
        "answers",
        "answered",
        "laws",
        "votes",
        "draws",
        "drawn",
        "things",
    }
    assert [word for word in RETIRED.keys() - plain if word not in glossary] == []
