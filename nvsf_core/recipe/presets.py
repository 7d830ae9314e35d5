"""The presets by name (`lean`, `quick`, `short`, `smoke`, the paper's), and those with smaller step sizes."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from nvsf_core.errors import RecipeError
from nvsf_core.names import LONGEST_NAME
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.paper import (
    EncoderSpec,
    FlowSpec,
    GradientLossSpec,
    GridSpec,
    PaperLosses,
    PaperOptimiser,
    PaperRecipe,
    PaperSampling,
    PlanesSpec,
    ReferenceQuirks,
    RefinementSpec,
    TimeGridSpec,
)
from nvsf_core.recipe.residual import HitsSpec, PanoSpec, ResidualRecipe, TrainingSpec

_QUICK = ResidualRecipe(name="quick")
# As quick, but with nearly five times the LiDAR's steps; more make its hits worse (decision 0036). Of the
# images, aligned poses give most; more steps of their depth network nothing (decision 0050).
_LEAN = replace(
    _QUICK,
    name="lean",
    lidar_training=replace(_QUICK.lidar_training, steps=4000, final_share=0.3),
    hits=HitsSpec(training=TrainingSpec(steps=600, rays=17_000)),
    pano=PanoSpec(training=TrainingSpec(steps=400, rays=17_000)),
    camera=replace(_QUICK.camera, aligned=True),
)
# The demo's: on its few scans what is learned wins after some 500 steps.
_SHORT = replace(_QUICK, name="short", lidar_training=replace(_QUICK.lidar_training, steps=560))
_SMOKE = replace(
    _QUICK,
    name="smoke",
    lidar_training=replace(_QUICK.lidar_training, steps=20, rays=256, checkpoint_s=1.0),
    hits=HitsSpec(frames=2, training=TrainingSpec(steps=5, rays=512, checkpoint_s=1.0)),
    depth_training=TrainingSpec(steps=10, rays=512, checkpoint_s=1.0),
)

_PAPER = PaperRecipe(name="paper")
_PAPER_AUTHORS = replace(
    _PAPER,
    name="paper_authors",
    # Half of the sums over clouds of 8192 points, not their means.
    losses=PaperLosses(flow=4096.0, gradient=0.1, chamfer=1.0, flow_magnitude=1.0),
    slips=ReferenceQuirks(
        flow_unit=True,
        neighbour_times=True,
        bound=2.0,
        minmax_box=True,
        half_precision_truth=True,
        recorded_elevations=True,
        identical_tables=True,
    ),
)

_SMALL_ENCODER = EncoderSpec(
    static=GridSpec(levels=6, features=4, log2_table=15, base_resolution=32, finest_resolution=2048),
    dynamic=TimeGridSpec(levels=6, log2_tables=(15, 13, 13), base_resolution=32, finest_resolution=2048),
    planes=PlanesSpec(scales=(1, 4)),
)
_PAPER_CPU = PaperRecipe(
    name="paper_cpu",
    encoder=_SMALL_ENCODER,
    flow=FlowSpec(
        grid=GridSpec(levels=8, features=8, log2_table=15, base_resolution=32, finest_resolution=2048),
        points=2048,
    ),
    sampling=PaperSampling(rays=256, samples=96),
    optimiser=PaperOptimiser(steps=100, head_rate=1e-2, checkpoint_s=30.0),
    refinement=RefinementSpec(channels=8, steps=30, rate=1e-2, frames_a_step=1, panos=3, column_step=4),
)
_TINY_GRID = GridSpec(levels=2, features=4, log2_table=8, base_resolution=16, finest_resolution=64)
_PAPER_SMOKE = replace(
    _PAPER_CPU,
    name="paper_smoke",
    encoder=EncoderSpec(
        static=_TINY_GRID,
        dynamic=TimeGridSpec(
            slices=3, levels=2, log2_tables=(8, 8, 8), base_resolution=16, finest_resolution=64
        ),
        planes=PlanesSpec(scales=(1,), space_resolution=8, time_resolution=4),
    ),
    flow=FlowSpec(grid=replace(_TINY_GRID, features=8), hidden=16, points=64),
    sampling=PaperSampling(rays=64, rays_at_once=48, samples=12),
    optimiser=PaperOptimiser(steps=12, checkpoint_s=0.0),
    refinement=RefinementSpec(channels=8, steps=3, frames_a_step=1, panos=2, column_step=4),
)


def _ablation_row(
    name: str, *, heuristic: bool = False, aligned: bool = False, multimodal: bool = False
) -> PaperRecipe:
    """One row of the paper's ablation, at the size of `paper_cpu`: the baseline plus some parts."""
    single = GradientLossSpec(mask="single", threshold_m=0.01)
    return replace(
        _PAPER_CPU,
        name=f"paper_cpu_{name}",
        gradient=_PAPER_CPU.gradient if aligned else single,
        sampling=replace(_PAPER_CPU.sampling, heuristic=heuristic, camera=multimodal),
    )


ABLATION = (
    _ablation_row("bl"),
    _ablation_row("bl_hs", heuristic=True),
    _ablation_row("bl_fa", aligned=True),
    _ablation_row("bl_ml", multimodal=True),
    _ablation_row("all", heuristic=True, aligned=True, multimodal=True),
)
"""BL, + heuristic sampling, + double-gradient mask (feature alignment), + camera rays (multimodal), all."""

ENCODINGS = (
    replace(_PAPER_CPU, name="paper_cpu_same", encoders="same"),
    replace(_PAPER_CPU, name="paper_cpu_separate", encoders="separate"),
    replace(_PAPER_CPU, name="paper_cpu_separate_fused", encoders="separate_fused"),
)
"""The paper's three ways of encoding two sensors."""

_PRESETS: dict[str, Recipe] = {
    recipe.name: recipe
    for recipe in (
        _LEAN,
        _QUICK,
        _SHORT,
        _SMOKE,
        _PAPER,
        replace(_PAPER, name="paper_same", encoders="same"),
        replace(_PAPER, name="paper_separate_fused", encoders="separate_fused"),
        _PAPER_AUTHORS,
        _PAPER_CPU,
        _PAPER_SMOKE,
        *ABLATION,
        *ENCODINGS,
    )
}

_FAMILIES: dict[str, type[Recipe]] = {"residual": ResidualRecipe, "paper": PaperRecipe}


def preset_names() -> list[str]:
    """Names of all presets, ours first."""
    return list(_PRESETS)


def preset(name: str) -> Recipe:
    """A recipe by name; `name@0.5` is the same with step sizes halved.

    Raises:
        RecipeError: There is no recipe of that name, or the share is invalid.
    """
    if not isinstance(name, str) or len(name) > LONGEST_NAME:
        raise RecipeError(f"expected a recipe's name, found {name!r:.60}")
    full = full_name(name)
    if full not in _PRESETS:
        raise RecipeError(f"no recipe {full!r}; there are {', '.join(sorted(_PRESETS))}")
    return _PRESETS[full] if full == name else slower(_PRESETS[full], share_of(name))


def recipe_from_json(values: dict[str, Any]) -> Recipe:
    """Read back what `to_json` gave.

    Raises:
        RecipeError: The family is unknown, or a field is unknown or missing.
    """
    family = values.get("family")
    if family not in _FAMILIES:
        raise RecipeError(f"expected a recipe of the family {' or '.join(_FAMILIES)}, found {family!r}")
    return _FAMILIES[family].from_json(values)


_MARK = "@"
_LEAST_SHARE = 1e-6
_RATES = ("rate", "table_rate", "network_rate", "head_rate", "flow_rate")
_Kind = TypeVar("_Kind", bound=Recipe)


def slower(recipe: _Kind, share: float) -> _Kind:
    """The recipe with all optimisers' step sizes times `share`, which its new name ends with.

    Raises:
        RecipeError: The share is not above 0 and at most 1.
    """
    if not _LEAST_SHARE <= share <= 1.0:
        raise RecipeError(
            f"recipe {recipe.name}: expected a share of its rates from {_LEAST_SHARE:g} to 1, found {share}"
        )
    slowed = _with_rates(recipe, lambda rate: rate * share)
    return replace(slowed, name=f"{full_name(recipe.name)}{_MARK}{share:g}")


def full_name(name: str) -> str:
    """The recipe's name without its share of step sizes."""
    return name.partition(_MARK)[0]


def share_of(name: str) -> float:
    """The share of step sizes in a recipe's name; 1 without one.

    Raises:
        RecipeError: The text after the mark is not a number.
    """
    _, mark, share = name.partition(_MARK)
    try:
        return float(share) if mark else 1.0
    except ValueError:
        raise RecipeError(f"recipe {name!r}: expected a number after {_MARK}, found {share!r}") from None


def differ_in_step_size(one: Recipe, other: Recipe) -> bool:
    """Whether two recipes differ in their step sizes and in nothing else but their names."""
    same, also = (replace(_with_rates(recipe, lambda _: 1.0), name="same") for recipe in (one, other))
    return one != other and type(one) is type(other) and bool(same == also)


def _with_rates(spec: Any, change: Callable[[float], float]) -> Any:
    changed: dict[str, Any] = {}
    for field in fields(spec):
        value = getattr(spec, field.name)
        if is_dataclass(value):
            changed[field.name] = _with_rates(value, change)
        elif field.name in _RATES:
            changed[field.name] = change(value)
    return replace(spec, **changed) if changed else spec
