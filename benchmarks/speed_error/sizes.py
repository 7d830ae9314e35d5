"""How large `paper_cpu` should be on a scene: six sizes, a minute each, compared on left-out frames."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.speed_error.plan import VAL, OneRun, read_result
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.recipe.presets import preset
from nvsf_core.reporting.speed_error import METRICS, final_values

SIZE_SECONDS = 60.0
"""Training time of each size, its U-Net left out."""
NAME = "paper_cpu"


def _size(log2_table: int, rays: int, samples: int) -> PaperRecipe:
    base = preset(NAME)
    assert isinstance(base, PaperRecipe)
    encoder = base.encoder
    tables = (log2_table, log2_table - 2, log2_table - 2)
    return replace(
        base,
        name=f"{NAME}_t{log2_table}_r{rays}_s{samples}",
        encoder=replace(
            encoder,
            static=replace(encoder.static, log2_table=log2_table),
            dynamic=replace(encoder.dynamic, log2_tables=tables),
        ),
        sampling=replace(base.sampling, rays=rays, samples=samples),
    )


SIZES: Mapping[str, PaperRecipe] = {
    size.name: size
    for size in (_size(t, rays, samples) for t in (13, 15, 17) for rays, samples in ((256, 96), (512, 48)))
}
"""By name: entries a hash level as a power of two, rays a step, samples a ray."""


def chosen_size(results: Path, scene: str, seed: int) -> PaperRecipe:
    """The size with the best mean rank over the curves' metrics, named `paper_cpu`.

    Raises:
        FileNotFoundError: A size was not measured yet.
    """
    values = {}
    for name in SIZES:
        path = OneRun(scene, VAL, name, seed).path(results)
        found = read_result(path)
        if found is None:
            raise FileNotFoundError(f"{path}: expected the run of this size, found none; run the sizes first")
        values[name] = final_values(found)
    ranks = mean_ranks(values)
    return replace(SIZES[min(ranks, key=lambda name: ranks[name])], name=NAME)


def mean_ranks(values: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Name to its mean rank (0 = best) over the metrics that every name has."""
    shared = [m for m in METRICS if all(m.key in mine for mine in values.values())]
    ranks: dict[str, list[int]] = {name: [] for name in values}
    for metric in shared:
        order = sorted(values, key=lambda name: values[name][metric.key], reverse=metric.higher_is_better)
        for rank, name in enumerate(order):
            ranks[name].append(rank)
    return {name: sum(mine) / len(mine) for name, mine in ranks.items()}


def timed(recipe: PaperRecipe, seconds_a_step: float, seconds: float) -> PaperRecipe:
    """The recipe with as many steps as fit, so that its rates decay just until then."""
    steps = max(1, round(seconds / seconds_a_step))
    return replace(recipe, optimiser=replace(recipe.optimiser, steps=steps))


def probe(recipe: PaperRecipe, steps: int) -> PaperRecipe:
    """A few steps of it and no U-Net, to see how long one takes."""
    optimiser = replace(recipe.optimiser, steps=steps)
    return replace(recipe, optimiser=optimiser, refinement=replace(recipe.refinement, channels=0))


def sizes_rows(found: Sequence[Mapping[str, Any]]) -> list[tuple[str, dict[str, float], float]]:
    """Name, errors and mean rank of each size that was measured, best first; other runs are left out."""
    names = {result["run"]["recipe"]: result for result in found}
    values = {name: final_values(result) for name, result in names.items() if name in SIZES}
    ranks = mean_ranks(values)
    return [(name, values[name], ranks[name]) for name in sorted(values, key=lambda name: ranks[name])]
