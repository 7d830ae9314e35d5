"""SIGKILL: to a whole run, as when the power goes; to one of its steps; to what serves the steps."""

from benchmarks.chaos.event import Event, Harm, Random
from benchmarks.chaos.processes import Running, descendants, kill, words_of
from benchmarks.chaos.world import LONGEST_RUN_S, World

_A_RUN_S = 45.0
_A_BARE_RUN_S = 1.5
_GOES_ON = r"dagster/job|died twice|report  |RUN_SUCCESS|next: open the report"


def kill_run(world: World, random: Random) -> Harm:
    """Kill a run with all its processes at a random moment."""
    world.provoke()
    run = world.start(NVSF_EXECUTOR=random.choice(["in_process", "multiprocess"]))
    moment_s = random.uniform(0.0, _A_BARE_RUN_S if world.bare else _A_RUN_S)
    run.sleep(moment_s)
    was_alive = run.is_alive
    run.kill()
    return Harm(f"after {moment_s:.0f} s" if was_alive else "after its end")


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


EVENTS = [
    Event("kill_run", "SIGKILL to a run and its steps", kill_run, weight=4),
    Event("kill_step", "SIGKILL to one process of a run", kill_step, needs_dagster=True, weight=4),
]
