"""Speed against error: every run that is still to be done, one after the other, then the document.

``python -m benchmarks.speed_error.curves [--document]``; what to run comes from the environment, as for
``make bench``: SCENES, RECIPES, SEEDS, SPLITS and MARKS (see `asked_from`). A finished run leaves its JSON
under benchmarks/results/curves/ and is not repeated unless its recipe changed; delete the file to repeat it.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

from benchmarks.speed_error.document import write_document
from benchmarks.speed_error.plan import FULL, MARKS_S, RESULTS, VAL, OneRun, read_result
from benchmarks.speed_error.sizes import NAME as PAPER_CPU
from benchmarks.speed_error.sizes import SIZE_SECONDS, SIZES, chosen_size
from nvsf_core.drives.catalogue import catalogue_from_environment
from nvsf_core.drives.drive import has_data
from nvsf_core.metrics.table import BASELINES
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.recipe.presets import preset
from nvsf_core.stages.runner.run import DEMO_SCENE, say_on_stderr

SCENE = "k360_street"
"""The default where the catalogue has it with data; else the demo."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """What to measure."""

    scenes: tuple[str, ...]
    recipes: tuple[str, ...]
    seeds: tuple[int, ...]
    """Of recipes of the paper's family only the first is trained."""
    splits: tuple[str, ...]
    marks_s: tuple[float, ...]

    def runs(self) -> Iterator[OneRun]:
        """The baselines first, the first seed of all recipes before the second."""
        for scene, split in product(self.scenes, self.splits):
            yield from (OneRun(scene, split, name, 0) for name in BASELINES)
            for seed, name in product(self.seeds, self.recipes):
                if seed == self.seeds[0] or not isinstance(preset(name), PaperRecipe):
                    yield OneRun(scene, split, name, seed)


def asked_from(environ: Mapping[str, str]) -> Asked:
    """Read SCENES (default: k360_street), RECIPES (lean paper_cpu), SEEDS (0 1 2), SPLITS (full), MARKS."""

    def words(*names: str, default: str) -> tuple[str, ...]:
        found = next((environ[name] for name in names if environ.get(name, "").strip()), default)
        return tuple(dict.fromkeys(found.split()))

    known = {entry.name for entry in catalogue_from_environment(environ) if has_data(entry)}
    return Asked(
        scenes=words("SCENES", default=SCENE if SCENE in known else DEMO_SCENE),
        recipes=words("RECIPES", "RECIPE", default=f"lean {PAPER_CPU}"),
        seeds=tuple(int(seed) for seed in words("SEEDS", default="0 1 2")),
        splits=words("SPLITS", default=FULL),
        marks_s=tuple(float(mark) for mark in words("MARKS", default=" ".join(map(str, MARKS_S)))),
    )


def measure(asked: Asked, results: Path = RESULTS) -> list[str]:
    """Do the runs that are not done, each in a process of its own; returns those that failed, in words."""
    failed: list[str] = []
    for run in asked.runs():
        if is_done(results, run):
            say_on_stderr(f"[{run.scene}] {run.recipe}, split {run.split}, seed {run.seed}: measured before")
            continue
        sizes = [*SIZES, *BASELINES] if run.recipe == PAPER_CPU else []
        first = [run._replace(split=VAL, recipe=size) for size in sizes]
        wanted = [(one, (SIZE_SECONDS,)) for one in first if not is_done(results, one)]
        for one, marks in [*wanted, (run, asked.marks_s)]:
            command = (*map(str, one), "--marks", *map(str, marks))
            code = _prepare(one.scene, one.split) or _process(*command)
            if code:
                failed.append(
                    f"{one.scene}, split {one.split}, {one.recipe}, seed {one.seed}: exit code {code}"
                )
                break
    return failed


def is_done(results: Path, run: OneRun) -> bool:
    """Whether the run left its JSON, with the recipe as it is today."""
    found = read_result(run.path(results))
    if found is None or run.recipe in BASELINES:
        return found is not None
    if run.recipe == PAPER_CPU:
        if not all(is_done(results, run._replace(split=VAL, recipe=size)) for size in SIZES):
            return False
        asked: Recipe = chosen_size(results, run.scene, run.seed)
    else:
        asked = SIZES[run.recipe] if run.recipe in SIZES else preset(run.recipe)
    identity: str = found["run"]["recipe_identity"]
    return identity == asked.identity()


@cache
def _prepare(scene: str, split: str) -> int:
    """The split's stages up to `evidence`, in a process whose memory is not the training's."""
    return _process(scene, split, "--prepare")


def _process(*arguments: str) -> int:
    command = [sys.executable, "-m", "benchmarks.speed_error.run", *arguments]
    return subprocess.run(command, check=False).returncode


def main() -> int:
    """Measure, then write docs/speed_and_error.md; 1 where a run failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--document", action="store_true", help="only write docs/speed_and_error.md")
    failed = [] if parser.parse_args().document else measure(asked_from(os.environ))
    print(write_document(RESULTS))
    for reason in failed:
        print(f"FAILED  {reason}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
