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
from pathlib import Path

from benchmarks.speed_error.document import write_document
from benchmarks.speed_error.plan import FULL, MARKS_S, RESULTS, VAL, read_result, result_path
from benchmarks.speed_error.sizes import NAME as PAPER_CPU
from benchmarks.speed_error.sizes import SIZE_SECONDS, SIZES, chosen_size
from nvsf_core.drives.catalogue import catalogue_from_environment, has_data
from nvsf_core.metrics.table import BASELINES
from nvsf_core.recipe import PaperRecipe, preset
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

    def runs(self) -> Iterator[tuple[str, str, str, int]]:
        """Scene, split, recipe and seed: the baselines first, the first seed of all before the second."""
        for scene in self.scenes:
            for split in self.splits:
                yield from ((scene, split, name, 0) for name in BASELINES)
                for seed in self.seeds:
                    for name in self.recipes:
                        if seed == self.seeds[0] or not isinstance(preset(name), PaperRecipe):
                            yield scene, split, name, seed


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
    for scene, split, recipe, seed in asked.runs():
        if is_done(results, scene, split, recipe, seed):
            say_on_stderr(f"[{scene}] {recipe}, split {split}, seed {seed}: measured before")
            continue
        sizes = [*SIZES, *BASELINES] if recipe == PAPER_CPU else []
        wanted = [
            (VAL, size, [SIZE_SECONDS]) for size in sizes if not is_done(results, scene, VAL, size, seed)
        ]
        for place, name, marks in [*wanted, (split, recipe, asked.marks_s)]:
            run = (scene, place, name, str(seed), "--marks", *map(str, marks))
            code = _prepare(scene, place) or _process(*run)
            if code:
                failed.append(f"{scene}, split {place}, {name}, seed {seed}: exit code {code}")
                break
    return failed


def is_done(results: Path, scene: str, split: str, recipe: str, seed: int) -> bool:
    """Whether the run left its JSON, with the recipe as it is today."""
    found = read_result(result_path(results, scene, split, recipe, seed))
    if found is None or recipe in BASELINES:
        return found is not None
    if recipe == PAPER_CPU:
        done = all(is_done(results, scene, VAL, size, seed) for size in SIZES)
        return done and found["run"]["recipe_identity"] == chosen_size(results, scene, seed).identity()
    asked = SIZES[recipe] if recipe in SIZES else preset(recipe)
    return found["run"]["recipe_identity"] == asked.identity()


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
