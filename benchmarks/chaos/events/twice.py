"""Two runs of one scene at once: of the same seed, of two seeds, of Dagster and of the library."""

import sys

from benchmarks.chaos.event import Event, Harm, Random
from benchmarks.chaos.processes import Running
from benchmarks.chaos.world import LONGEST_RUN_S, SCENE, World

_LIBRARY = "from nvsf_core.stages import run_scene; run_scene('{scene}', seed={seed})"
_DONE = r"evidence: (done|up to date)"


def two_runs(world: World, random: Random) -> Harm:
    """Start the same run twice, some seconds apart."""
    world.provoke()
    first = world.start()
    apart_s = random.uniform(0.0, 0.5 if world.bare else 12.0)
    first.sleep(apart_s)
    second = world.start()
    return _both(first, second, f"{apart_s:.0f} s apart; ")


def two_seeds(world: World, random: Random) -> Harm:
    """Start two runs that share all but the training."""
    world.provoke()
    first = world.start()
    world.provoke()
    second = world.start()
    return _both(first, second)


def with_library(world: World, random: Random) -> Harm:
    """Start a run of Dagster's and the library's own on the same outputs."""
    world.provoke()
    first = world.start()
    first.sleep(random.uniform(0.0, 10.0))
    code = _LIBRARY.format(scene=SCENE, seed=world.seed)
    second = world.launch([sys.executable, "-c", code], "library")
    return _both(first, second)


def _both(first: Running, second: Running, how: str = "") -> Harm:
    """What came of two runs at once: both must succeed."""
    codes = first.wait(LONGEST_RUN_S), second.wait(LONGEST_RUN_S)
    expected = _DONE if codes == (0, 0) else "both must succeed"
    return Harm(f"{how}exits {codes}", first.said + second.said, expected)


EVENTS = [
    Event("two_runs", "two runs of the same at once", two_runs, weight=3),
    Event("two_seeds", "two runs of two seeds at once", two_seeds, needs_dagster=True, weight=2),
    Event("with_library", "a run of Dagster and one of the library at once", with_library,
          needs_dagster=True),
]  # fmt: skip
