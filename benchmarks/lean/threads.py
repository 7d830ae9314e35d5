"""Time of a training step by number of CPU threads, and whether the weights have the same bits.

Run ``python -m benchmarks.lean.threads k360_street`` after the stage ``evidence`` of the scene, on an idle
machine; it writes docs/threads.md. Each number of threads trains a few steps of each part and hashes weights.
"""

import argparse
import contextlib
import hashlib
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest import mock

import numpy as np

from benchmarks.common.documents import DOCS
from nvsf_core.kernels.threads import use_threads
from nvsf_core.models.family import ResumedPart, family_of
from nvsf_core.models.residual import lidar as residual_lidar
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.residual import ResidualRecipe, TrainingSpec
from nvsf_core.recording.drive import Recording
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.host import machine
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.thread_count import VARIABLE
from nvsf_core.training import loop
from nvsf_core.training.loop import TrainingState

_STEPS = {"lidar": 60, "hits": 30, "pano": 30, "depth": 8}
_WARM_UP = 3
_NAMES = {
    "lidar": "LiDAR field", "hits": "network of hits", "pano": "network of the pano",
    "depth": "depth network",
}  # fmt: skip


@dataclass(slots=True)
class _Timed:
    """A training session that keeps the seconds of a step and a hash of the weights, and no checkpoints."""

    seed: int = 0
    step_s: dict[str, float] = field(default_factory=dict)
    alone_s: dict[str, float] = field(default_factory=dict)
    """Of a step outside its parts: what more threads cannot speed up."""
    digest: dict[str, str] = field(default_factory=dict)

    def say(self, part: str, line: str, /) -> None:
        """Say nothing."""

    @contextlib.contextmanager
    def resumed(self, part: str, state: TrainingState, /) -> Iterator[ResumedPart]:
        """Time the steps of a part after the first few."""
        ends: list[float] = []
        inside: list[float] = [0.0]
        in_parts = loop.in_parts

        def timed(*given):  # type: ignore[no-untyped-def]
            started = time.perf_counter()
            found = in_parts(*given)
            inside.append(inside[-1] + time.perf_counter() - started)
            return found

        loop.in_parts = timed
        try:
            yield ResumedPart(
                save=lambda *_: None, say=lambda _: None, observe=lambda _: ends.append(time.perf_counter())
            )
        finally:
            loop.in_parts = in_parts
        self.step_s[part] = (ends[-1] - ends[_WARM_UP - 1]) / (len(ends) - _WARM_UP)
        self.alone_s[part] = self.step_s[part] - (inside[-1] - inside[_WARM_UP]) / (len(ends) - _WARM_UP)
        digest = hashlib.sha256()
        for _, value in sorted(state.tensors().items()):
            digest.update(np.ascontiguousarray(value.detach().cpu().numpy()).tobytes())
        self.digest[part] = digest.hexdigest()[:12]


def main() -> None:
    """Measure, print and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--home", type=Path, default=Path(os.environ.get("NVSF_HOME", ".nvsf")))
    parser.add_argument("--recipe", default="lean")
    parser.add_argument("--threads", type=int, nargs="+", default=_counts())
    parser.add_argument("--out", type=Path, default=DOCS / "threads.md")
    asked = parser.parse_args()
    recipe = preset(asked.recipe)
    if not isinstance(recipe, ResidualRecipe):
        parser.error(f"--recipe: expected one of the residual family, found {asked.recipe!r}")
    recording = read_recording(SceneStore(asked.home, asked.scene))
    found = [_measured(_few_steps(recipe), recording, threads) for threads in asked.threads]
    page = _page(asked.scene, recipe, asked.threads, found)
    print(page)
    asked.out.write_text(page)


def _counts() -> list[int]:
    """1, 2, 4, ... up to the cores of this machine."""
    cores = len(os.sched_getaffinity(0))
    return [count for count in (1, 2, 4, 8, 16, 32, 64) if count <= cores]


def _few_steps(recipe: ResidualRecipe) -> ResidualRecipe:
    def few(spec: TrainingSpec, part: str) -> TrainingSpec:
        return replace(spec, steps=_STEPS[part], checkpoint_s=1e9)

    pano = recipe.pano
    return replace(
        recipe,
        lidar_training=few(recipe.lidar_training, "lidar"),
        depth_training=few(recipe.depth_training, "depth"),
        hits=recipe.hits and replace(recipe.hits, training=few(recipe.hits.training, "hits")),
        pano=replace(pano, training=few(pano.training, "pano")) if pano and pano.training else pano,
    )


def _measured(recipe: ResidualRecipe, recording: Recording, threads: int) -> _Timed:
    os.environ[VARIABLE] = str(threads)
    use_threads()
    session = _Timed()
    # After a few steps the field is worse than the evidence; then the networks behind it are not trained.
    with mock.patch.object(residual_lidar, "choose", lambda *_: (True, {"lidar_shows": "field"})):
        family_of(recipe).train(recipe, recording, session)
    print(f"{threads} threads: done", flush=True)
    return session


def _page(scene: str, recipe: ResidualRecipe, threads: Sequence[int], found: Sequence[_Timed]) -> str:
    first = found[0]
    head = " | ".join(f"ms, {count} thread{'s' * (count > 1)}" for count in threads)
    rows = []
    for part in first.step_s:
        times = " | ".join(f"{1000 * one.step_s[part]:,.1f}" for one in found)
        gain = first.step_s[part] / found[-1].step_s[part]
        alone = found[-1].alone_s[part] / found[-1].step_s[part]
        same = "yes" if len({one.digest[part] for one in found}) == 1 else "NO"
        rows.append(f"| {_NAMES[part]} | {times} | {gain:.2f} | {alone:.0%} | {same} |")
    most = threads[-1]
    return f"""# Threads

`python -m benchmarks.lean.threads {scene} --recipe {recipe.name}`, one run. {machine()}.
`NVSF_THREADS` says how many CPU threads a process uses; by default all cores.

| part, a training step | {head} | 1 thread / {most} | outside parts, of {most} threads' time | same bits |
| --- |{" ---: |" * (len(threads) + 2)} --- |
{chr(10).join(rows)}

Torch has one thread: divided by the number of threads, its sums and even its sigmoids have other bits. Work
is divided into parts that do not depend on that number, and sleeping threads take one part after the other.
So what limits beyond these columns is known: a step has {recipe.lidar_training.parts} parts, of the
depth network {recipe.depth_training.parts}, and more threads than parts gain nothing in it; then comes what
runs outside of parts (drawing, adding gradients, Adam). Up to eight views are rendered at once.
"""


if __name__ == "__main__":
    main()
