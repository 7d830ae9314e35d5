"""Seconds and memory of an iteration of the recipe `paper` at full size, written into docs/paper_fidelity.md.

Run ``python -m benchmarks.paper.step [--scene k360_street] [--steps 2]`` on an otherwise idle machine; on a
machine with a GPU it runs there. It needs NVSF_SCENES and NVSF_HOME as a training does.
"""

import argparse
import os
import resource
import time

import torch

from benchmarks.common import documents
from benchmarks.paper.ablation import prepared_recording
from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.models.family import training_device
from nvsf_core.models.paper.scene import training_frames
from nvsf_core.models.paper.step import paper_step
from nvsf_core.models.paper.training_frames import PaperFrames, PaperTrainee
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.stages.runner.host import machine
from nvsf_core.stages.runner.run import find_scene
from nvsf_core.training.adam import Adam

RESULTS = documents.RESULTS_DIR / "paper_step.json"
DOCUMENT = documents.DOCS / "paper_fidelity.md"


def measure(scene: str, steps: int) -> dict[str, object]:
    """Train `steps` iterations after one that is not timed; nothing of it is kept."""
    recipe = PaperRecipe(name="paper")
    _, recording = prepared_recording(find_scene(scene), recipe, home_from_environment(os.environ))
    found = iterations(recipe, training_frames(recipe, recording), steps)
    return {"scene": scene, "iterations": steps, **found, "machine": machine(), "commit": documents.commit()}


def iterations(recipe: PaperRecipe, frames: PaperFrames, steps: int) -> dict[str, object]:
    """The same of any recipe and drive: mean seconds of an iteration, memory, and the last one's loss.

    `peak_gpu_mb` is None without a GPU.
    """
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    trainee = PaperTrainee(recipe, frames, torch.Generator().manual_seed(0)).to(training_device())
    groups = trainee.field.parameter_groups(recipe.optimiser)
    optimiser = Adam(groups, betas=(0.9, 0.99), eps=1e-15)
    generator = torch.Generator().manual_seed(0)
    seconds: list[float] = []
    terms: set[str] = set()
    for step in range(steps + 1):
        started = time.perf_counter()
        optimiser.zero_grad()
        loss = 0.0
        for one in (one for part in paper_step(trainee, frames, 0, step, generator) for one in part()):
            one.total.backward()
            terms |= set(one.terms)
            loss += float(one.total.detach())
        optimiser.step()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - started)
        print(f"iteration {step}: {seconds[-1]:.3f} s", flush=True)
    rays = recipe.sampling.rays * (2 if frames.cameras else 1)
    mean_s = sum(seconds[1:]) / steps
    gpu_mb = torch.cuda.max_memory_allocated() / 2**20 if torch.cuda.is_available() else None
    return {
        "seconds": mean_s, "loss": loss, "rays_per_s": rays / mean_s,
        "rays": rays, "samples": recipe.sampling.samples, "terms": sorted(terms),
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, "peak_gpu_mb": gpu_mb,
    }  # fmt: skip


def table() -> str:
    """The measured rows as Markdown."""
    rows = [
        [
            f"`{row['scene']}`", f"{row['rays']} x {row['samples']}", ", ".join(row["terms"]),
            f"{row['seconds']:.1f}", f"{row['rays_per_s']:.0f}",
            f"{row['peak_gpu_mb'] or row['peak_memory_mb']:.0f}", row["machine"], row["commit"],
        ]
        for row in documents.read_rows(RESULTS)
    ]  # fmt: skip
    head = ["scene", "rays x samples", "loss terms", "s each", "rays/s", "peak MB", "machine", "commit"]
    return documents.markdown_table(head, rows, "| --- | --- | --- | ---: | ---: | ---: | --- | --- |")


def main() -> None:
    """Measure, keep the row beside those of other machines and scenes, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="k360_street")
    parser.add_argument("--steps", type=int, default=2)
    arguments = parser.parse_args()
    row = measure(arguments.scene, arguments.steps)
    key = (row["scene"], row["machine"])
    others = [one for one in documents.read_rows(RESULTS) if (one["scene"], one["machine"]) != key]
    documents.write_json(RESULTS, [*others, row])
    documents.write_between(DOCUMENT, "paper_step", table())
    print(table(), end="")


if __name__ == "__main__":
    main()
