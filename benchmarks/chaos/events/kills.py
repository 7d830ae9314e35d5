"""SIGKILL to a run, to one of its steps, to what removes; and two runs of one scene at once."""

import sys

from benchmarks.chaos.event import Event, Harm, Random
from benchmarks.chaos.processes import Running, descendants, kill, words_of
from benchmarks.chaos.world import LONGEST_RUN_S, SCENE, World
from nvsf_core.stores.removal import KEEP_VARIABLE

_A_RUN_S = 45.0
_A_BARE_RUN_S = 1.5
_GOES_ON = r"dagster/job|died twice|report  |RUN_SUCCESS|next: open the report|Run again"
_DRAWS = """
from nvsf_core.stages import find_scene, plan_run, run_named_stage
from nvsf_core.stages.runner.run import say_on_stderr
for draw in range({first}, {first} + {count}):
    run = plan_run(find_scene("{scene}"), "{home}", seed={seed}, draw_seed=draw, dataset_label="draws")
    run_named_stage("dataset", run, say_on_stderr)
"""
_MOST_DRAWS = 6
_LIBRARY = "from nvsf_core.stages import run_scene; run_scene('{scene}', seed={seed})"
_DONE = r"evidence: (done|up to date)"


def kill_run(world: World, random: Random) -> Harm:
    """Kill a run with all its processes at a random moment."""
    world.provoke()
    run = world.start(NVSF_EXECUTOR=random.choice(["in_process", "multiprocess"]))
    moment_s = random.uniform(0.0, _A_BARE_RUN_S if world.bare else _A_RUN_S)
    run.sleep(moment_s)
    was_alive = run.is_alive
    run.kill()
    return Harm(f"after {moment_s:.0f} s" if was_alive else "after its end")


def kill_assets(world: World, random: Random) -> Harm:
    """Kill a run of assets, which is of no job of ours and holds the pool, while it trains."""
    world.provoke()
    command = ["-m", "dagster", "asset", "materialize", "--select", "nvsf/field", "--partition", SCENE]
    run = world.launch([sys.executable, *command], "assets")
    run.wait_for("field: started", LONGEST_RUN_S)
    run.sleep(random.uniform(0.0, 2.0))
    was_alive = run.is_alive
    run.kill()
    return Harm("while it trained" if was_alive else "after its end", run.said, "field: started")


def kill_step(world: World, random: Random) -> Harm:
    """Kill one random process of a run; the run itself goes on."""
    world.provoke()
    run = world.start(NVSF_EXECUTOR="multiprocess")
    run.sleep(random.uniform(8.0, _A_RUN_S))
    name = _kill_one(run, random)
    code = run.wait(LONGEST_RUN_S)
    if name and code != 0 and not run.said.strip():
        return Harm(f"{name}; exit {code}", run.said, "nothing was said")
    expected = _GOES_ON if name else ""
    return Harm(f"{name or 'after its end'}; the run ends with {code}", run.said, expected)


def kill_removal(world: World, random: Random) -> Harm:
    """Draw data sets anew, of which the newest alone is kept, and kill that at a random moment."""
    first = 1 + random.randrange(10**6)
    code = _DRAWS.format(first=first, count=_MOST_DRAWS, scene=SCENE, home=world.home, seed=world.seed)
    run = world.launch([sys.executable, "-c", code], "draws", **{KEEP_VARIABLE: "1"})
    run.wait_for("removed by", LONGEST_RUN_S)
    run.sleep(random.uniform(0.0, 1.0))
    was_alive = run.is_alive
    run.kill()
    removed = run.said.count("removed by")
    return Harm(f"after {removed} were removed{'' if was_alive else ', at its end'}", run.said, "removed by")


def _kill_one(run: Running, random: Random) -> str:
    """Kill one process below a run's; what it was, empty if there was none."""
    below = [number for number in descendants(run.process.pid) if "python" in words_of(number)]
    if not below:
        return ""
    number = random.choice(below)
    words = words_of(number)
    kill(number)
    if "forkserver" in words:
        return "the server of the steps, or a step"
    return "the resource tracker" if "tracker" in words else "a step"


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
    Event("kill_run", "SIGKILL to a run and its steps", kill_run, weight=4),
    Event("kill_assets", "SIGKILL to a run of assets, as the UI starts", kill_assets, needs_dagster=True),
    Event(
        "kill_removal", "SIGKILL to who removes old versions of data sets", kill_removal, needs_dagster=True
    ),
    Event("kill_step", "SIGKILL to one process of a run", kill_step, needs_dagster=True, weight=4),
    Event("two_runs", "two runs of the same at once", two_runs, weight=3),
    Event("two_seeds", "two runs of two seeds at once", two_seeds, needs_dagster=True, weight=2),
    Event(
        "with_library", "a run of Dagster and one of the library at once", with_library, needs_dagster=True
    ),
]
