"""The resource of every asset and op: recipe, seeds, and the folder of the outputs."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import dagster as dg
from pydantic import Field

from nvsf_core.drives.catalogue import SceneEntry, catalogue_from_environment, home_from_environment
from nvsf_core.errors import NvsfError
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.seed import seed_from_text
from nvsf_core.stages import Outcome, RunConfig, SceneRun, Stage, find_scene, plan_run, run_named_stage
from nvsf_core.stages.runner.failures import remember_failure
from nvsf_core.stages.runner.patience import patiently
from nvsf_core.stages.runner.run import DEFAULT_RECIPE
from nvsf_core.stages.runner.stage import Progress
from nvsf_core.stages.runner.trained import newest_field
from nvsf_core.stores.removal import number_kept
from nvsf_core.stores.scene_store import SceneStore, require_home

_LABEL = "manual"


class Workspace(dg.ConfigurableResource):
    """Recipe, seeds and data set label of a run; empty fields are read from the environment."""

    # Dagster's launchpad lets null through for each field that has a default.
    recipe: str | None = Field(
        default=None,
        description="Preset; empty = RECIPE, else the catalogue's choice for the scene, else `lean`.",
    )
    seed: int | None = Field(default=None, description="Seed of training; empty = SEED, else 0.")
    draw_seed: int | None = Field(
        default=None,
        description="Seed of ray drop and range noise in a data set; empty = 0, in `regenerate_synthetic` "
        "one of its own.",
    )
    dataset_label: str | None = Field(
        default=_LABEL, description=f"First part of a data set's version; empty = {_LABEL}."
    )

    def home(self) -> Path:
        """NVSF_HOME, else `.nvsf` in the working directory."""
        return home_from_environment(os.environ)

    def plan(self, scene: str) -> SceneRun:
        """The run of the scene of that name.

        Raises:
            DataError: The catalogue cannot be read or has no such scene, or the label cannot be part of a
                folder's name.
            RecipeError: There is no such recipe, or a seed is not valid.
            StoreError: The home cannot be written to.
        """
        return self._planned(find_scene(scene), keep=False, draw_seed=0)

    def _planned(self, entry: SceneEntry, *, keep: bool, draw_seed: int) -> SceneRun:
        choices, kept = self._choices(), None
        if keep and not self.recipe and self.seed is None:
            kept = newest_field(self.home() / entry.name)
        if kept is not None:
            choices |= {"recipe": kept[0], "seed": kept[1]}
        if self.draw_seed is None:
            choices |= {"draw_seed": draw_seed}
        return plan_run(entry, self.home(), **choices)

    def run_stage(
        self,
        name: str,
        scene: str,
        progress: Progress,
        *,
        stages: Sequence[Stage],
        keep: bool = False,
        draw_seed: int = 0,
    ) -> Outcome:
        """Run, or skip, a stage on a scene; why it could not even be planned is remembered, too.

        A catalogue that cannot be read is waited for, as somebody may be editing it.

        Args:
            name: Name of the stage.
            scene: Name of the scene.
            progress: Receives progress lines.
            stages: All stages of the flow.
            keep: Take recipe and seed of the scene's newest field, if it has one and this run names none.
            draw_seed: Of the run, which counts if it names none.

        Raises:
            NvsfError: It cannot be planned, or the stage failed.
        """
        entry = patiently(lambda: find_scene(scene), progress)
        try:
            run = self._planned(entry, keep=keep, draw_seed=draw_seed)
        except NvsfError as error:
            remember_failure(SceneStore(self.home(), entry.name), name, str(error))
            raise
        return run_named_stage(name, run, progress, stages=stages)

    def recipe_of(self, entry: SceneEntry) -> str:
        """Name of the recipe that is asked for: by this run, by RECIPE, by the catalogue, else `lean`."""
        return str(self._choices()["recipe"] or entry.recipe or DEFAULT_RECIPE)

    def require_possible(self) -> None:
        """Check everything of a run that does not depend on the scene.

        Raises:
            NvsfError: The recipe, a seed, the label, home or weights of LPIPS are not valid; the error
                that `plan` raises, which does not read the weights.
        """
        from nvsf_core.metrics.lpips import load_lpips  # loads torch, which nothing else here needs

        require_home(self.home())
        number_kept(os.environ)
        choices = self._choices()
        RunConfig(**{**choices, "recipe": preset(choices["recipe"] or DEFAULT_RECIPE)})
        load_lpips()  # the stage `scene_metrics` would fail, after training

    def _choices(self) -> dict[str, Any]:
        return {
            "recipe": self.recipe or os.environ.get("RECIPE") or None,
            "seed": seed_from_text(os.environ.get("SEED") or "0", "SEED") if self.seed is None else self.seed,
            "draw_seed": self.draw_seed or 0,
            "dataset_label": self.dataset_label or _LABEL,
        }


def catalogue() -> tuple[SceneEntry, ...]:
    """Every scene that NVSF_SCENES (or the project's scenes.toml) names."""
    return catalogue_from_environment(os.environ)
