"""What a run says at its end: what it gained, where its files lie, and commands that go on from there.

A command is written so that a new shell takes it, in any folder: with the variables that this run had, and
with the path of its program.
"""

import os
import shlex
import sys
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.metrics.headline import headline
from nvsf_core.stages import SceneRun
from nvsf_core.stages.runner.trained import newest_field

SceneState = dict[str, Any]
"""Passed from stage to stage: `scene`, `failed` ("" or why), `stages` (name, seconds, skipped), `exports`,
`doubts` (failed checks in words)."""
_WIDTH, _MOST_DOUBTS, _MOST_LINES = 79, 4, 4


def closing_words(
    rows: Sequence[Mapping[str, Any]],
    states: Sequence[SceneState],
    failures: Mapping[str, str],
    absent: Sequence[str],
    report: Path,
) -> list[str]:
    """Lines about what each scene gained, which checks doubt it, and where its files lie.

    Args:
        rows: Of the tables of metrics of all scenes.
        states: What each scene's stages passed on.
        failures: Scene to why it failed.
        absent: Scenes without data.
        report: The page over all scenes.
    """
    lines = [""]
    for state in states:
        scene = state["scene"]
        seconds = sum(one["seconds"] for one in state["stages"] if not one["skipped"])
        done = f"{len(state['stages'])} stages, " + (f"{seconds:.0f} s" if seconds else "up to date")
        if scene not in failures:
            result = headline([row for row in rows if row["scene"] == scene])
            lines += [result or f"{scene}: nothing was measured", f"  {done}"]
        elif state["stages"]:
            lines += [f"{scene}: failed after {done}"]
        lines += _doubts(state["doubts"])
        lines += [f"  scans  {_short(Path(folder))}" for folder in state["exports"]]
    lines += [f"FAILED  {scene}: {reason}" for scene, reason in failures.items()]
    if absent:
        lines.append(f"no data: {', '.join(absent)}")
    return [*lines, f"report  {_short(report)}"]


def _doubts(doubts: Sequence[str]) -> list[str]:
    """A few lines each of the first failed checks, of the terminal's width: the report has the whole."""
    lines = [
        line
        for one in doubts[:_MOST_DOUBTS]
        for line in textwrap.wrap(
            one, _WIDTH, initial_indent="  doubt  ", subsequent_indent=" " * 9, max_lines=_MOST_LINES,
            placeholder=" ...", break_on_hyphens=False,
        )
    ]  # fmt: skip
    more = len(doubts) - _MOST_DOUBTS
    return [*lines, f"  and {more} more: the report says what they found"] if more > 0 else lines


def next_view(run: SceneRun) -> list[str]:
    """Lines with the command that renders a view by the field of a run."""
    recipe, seed = run.config.recipe.name, run.config.seed
    asked = ["view", run.scene.name, "shift_m = [0, 1, 0]"]
    if newest_field(run.store.root) != (recipe, seed):  # which `nvsf view` takes by itself
        asked += ["--recipe", recipe, "--seed", str(seed)]
    return [
        "next: open the report in a browser; look at the scans; ask for another pose, time or sensor:",
        f"  {_command([str(Path(sys.executable).with_name('nvsf')), *asked])}",
    ]


def next_ui(run_id: str) -> list[str]:
    """Lines with the command that starts Dagster's UI, and where it shows a run."""
    package = Path(__file__).resolve().parent
    root = package.parent
    place = {"DAGSTER_HOME": _absolute(os.environ.get("DAGSTER_HOME", ""))}
    command = _command(["make", "-C", str(root), "ui"], place)
    if not (root / "Makefile").is_file() or "'" in command:  # make takes no path with a blank
        program = str(Path(sys.executable).with_name("dagster"))
        # With -m the code location has another name than the one that runs of a terminal say they are of.
        words = ["env", "-u", "DAGSTER_MODULE_NAME", program, "dev", "-w", str(_workspace(package))]
        command = _command(words, place)
    return ["the lineage, and all of this run, in Dagster's UI on http://127.0.0.1:3000:", f"  {command}",
            f"  then /runs/{run_id}"]  # fmt: skip


def _workspace(package: Path) -> Path:
    """The file that names the code location: beside the package in a checkout, in it once installed."""
    beside = package.parent / "workspace.yaml"
    return beside if beside.is_file() else package / "workspace.yaml"


def _command(words: Sequence[str], more: Mapping[str, str] | None = None) -> str:
    """A command with this run's variables before it."""
    catalogues = [one for one in os.environ.get("NVSF_SCENES", "").split(os.pathsep) if one]
    values = {
        "NVSF_HOME": _absolute(str(home_from_environment(os.environ))),
        "NVSF_SCENES": os.pathsep.join(map(_absolute, catalogues)),
        "NVSF_KITTI360_ROOT": _absolute(os.environ.get("NVSF_KITTI360_ROOT", "")),
        **(more or {}),
    }
    given = [f"{name}={shlex.quote(value)}" for name, value in values.items() if value]
    return " ".join([*given, shlex.join(words)])


def _absolute(path: str) -> str:
    return path and os.path.abspath(os.path.expanduser(path))


def _short(path: Path) -> str:
    """The path as seen from here, where that is shorter."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)
