"""Read a scene's drive and outputs anew, byte by byte, and say which stages are up to date."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

from nvsf_core.errors import NvsfError
from nvsf_core.stages.runner.contents import hashes_of
from nvsf_core.stages.runner.execution import compared
from nvsf_core.stages.runner.locks import LOCKS, output_locks
from nvsf_core.stages.runner.record import damage_of, read_record
from nvsf_core.stages.runner.run import SceneRun, place_of, say_on_stderr
from nvsf_core.stages.runner.stage import Progress, Stage
from nvsf_core.stores.file_hashes import FileHashes


class Verdict(Enum):
    """The state of an output, in the words that users read."""

    UP_TO_DATE = "up to date"
    ABSENT = "not made"
    CHANGED = "would be made again"
    DAMAGED = "DAMAGED"


@dataclass(frozen=True, slots=True, kw_only=True)
class Verified:
    """The state of one stage's output, and why."""

    stage: str
    verdict: Verdict
    words: str = ""
    """Why it would be made again, or which file is damaged."""


def verify_scene(
    run: SceneRun, stages: Sequence[Stage], progress: Progress = say_on_stderr
) -> Iterator[Verified]:
    """Compare every published output of a run with all that it was made from; nothing is made.

    The recorded files are read anew, whatever is remembered of them, and so are the outputs' own. What
    another run replaces while it is read looks damaged: that run is waited for, and it is looked at again.
    """
    by_name = {stage.name: stage for stage in stages}
    # One reader for all: it reads each file once.
    with hashes_of(run.store, read_anew=True) as hashes:
        for stage in stages:
            found = _verified(stage, run, by_name, hashes)
            if found.verdict is Verdict.DAMAGED:
                place = stage.location(run.config)
                # In a home that cannot be written, as an archive, nobody makes a lock, and nobody writes.
                with (
                    contextlib.suppress(OSError),
                    output_locks(run.store.home / LOCKS / run.scene.name, None, [place], progress),
                ):
                    found = _verified(stage, run, by_name, hashes)
            yield found


def _verified(stage: Stage, run: SceneRun, by_name: dict[str, Stage], hashes: FileHashes) -> Verified:
    place = place_of(stage, run, by_name)
    try:
        record = read_record(run.store.recovered(place.location))
        if record is None:
            return Verified(stage=stage.name, verdict=Verdict.ABSENT)
        damage = damage_of(run.store, place.location, record)
        if damage is not None:
            return Verified(stage=stage.name, verdict=Verdict.DAMAGED, words=damage)
        found = compared(place, hashes)
    except (NvsfError, OSError) as error:
        return Verified(stage=stage.name, verdict=Verdict.CHANGED, words=str(error))
    verdict = Verdict.UP_TO_DATE if found.is_up_to_date else Verdict.CHANGED
    return Verified(stage=stage.name, verdict=verdict, words=found.reason)
