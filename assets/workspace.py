"""What a run was asked for and where its outputs lie: the one resource of every asset and op."""

import os
from pathlib import Path

import dagster as dg

from nvsf_core.errors import DataError
from nvsf_core.kitti360.catalogue import SceneEntry, catalogue_from_environment, home_from_environment
from nvsf_core.stages import SceneRun, find_scene, plan_run


class Workspace(dg.ConfigurableResource):
    """Recipe, seeds and places of a run; what is left empty comes from the environment."""

    recipe: str = ""
    """Preset; empty = RECIPE, else the catalogue's choice for the scene, else `lean`."""
    seed: int | None = None
    """Seed of training; None = SEED, else 0."""
    draw_seed: int = 0
    """Seed of what is random in a data set."""
    dataset_label: str = "manual"
    """First part of a data set's version."""

    def home(self) -> Path:
        """NVSF_HOME, else `.nvsf` in the working directory."""
        return home_from_environment(os.environ)

    def plan(self, scene: str) -> SceneRun:
        """What to run on the scene of that name.

        Raises:
            DataError: The catalogue has no such scene, or SEED is no number.
            RecipeError: There is no such recipe.
        """
        return plan_run(
            find_scene(scene),
            self.home(),
            recipe=self.recipe or os.environ.get("RECIPE") or None,
            seed=_seed_from_environment() if self.seed is None else self.seed,
            draw_seed=self.draw_seed,
            dataset_label=self.dataset_label,
        )


def catalogue() -> tuple[SceneEntry, ...]:
    """Every scene that NVSF_SCENES (or the project's scenes.toml) names."""
    return catalogue_from_environment(os.environ)


def _seed_from_environment() -> int:
    text = os.environ.get("SEED") or "0"
    if not text.isdecimal():
        raise DataError(f"SEED={text!r}: expected a whole number, 0 or greater")
    return int(text)
