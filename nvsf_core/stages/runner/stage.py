"""What a stage, its checks, its run and its outcome are."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from nvsf_core._types import Scalar
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.errors import CheckFailedError, DataError
from nvsf_core.names import name_fault
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.seed import require_seed
from nvsf_core.stores.scene_store import SceneStore

NOT_RUN = "not run"
"""First words of the detail of a check that could not be made."""


class Progress(Protocol):
    """Receives progress lines for the user."""

    def __call__(self, line: str, /) -> None:
        """Show `line`."""


class Observer(Protocol):
    """Watches a training from outside, for example to score it at given seconds."""

    def __call__(self, part: str, state: Any, /) -> None:
        """See a part of the model after one of its steps.

        Args:
            part: Name of the checkpoint's file: `lidar`, `camera`, ...
            state: A `nvsf_core.training.loop.TrainingState`, not to be changed. (Typed `Any` because its
                module loads torch, which importing this one must not.)
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class RunConfig:
    """Recipe, seeds and data set label of a run."""

    recipe: Recipe
    """Recipe of training and rendering."""
    seed: int = 0
    """Seed of training."""
    draw_seed: int = 0
    """Seed of ray drop and range noise in a data set."""
    dataset_label: str = "manual"
    """First part of a data set's version: an ISO week, or `manual`."""

    def __post_init__(self) -> None:
        """Refuse seeds that are not valid, and a label that cannot be part of a folder's name."""
        require_seed(self.seed)
        require_seed(self.draw_seed, "draw_seed")
        fault = name_fault(self.dataset_label)
        if fault is not None:
            raise DataError(f"dataset_label: {fault}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """The outcome of one check of a stage's output."""

    name: str
    """The condition in snake_case, for example `all_frames_have_a_pose`."""
    passed: bool
    """Whether the condition holds."""
    detail: str
    """Findings in words and numbers."""
    blocking: bool = False
    """A failed blocking check keeps the output from being published."""
    value: float | None = None
    """The measured number; None if the check has none, or was not run."""
    limit: float | None = None
    """Largest allowed `value`."""
    unit: str = ""
    """Unit of both; empty for shares and counts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedCheck:
    """A check that a stage makes of every scene; the UI and the report show it separately."""

    name: str
    """Name of its `Check`."""
    description: str
    """The condition, its reason, and the source of its limit."""
    blocking: bool = False
    """Whether a failure makes the output unusable; else it only warns."""

    def outcome(self, value: float, limit: float, detail: str) -> Check:
        """The check's outcome: passed if `value` is at most `limit`; NaN fails."""
        return Check(
            name=self.name, passed=value <= limit, detail=detail, blocking=self.blocking, value=value,
            limit=limit,
        )  # fmt: skip

    def not_run(self, reason: str) -> Check:
        """The outcome if the check could not be made: passed, with the reason."""
        return Check(name=self.name, passed=True, detail=f"{NOT_RUN}: {reason}", blocking=self.blocking)


class UnsoundOutputError(CheckFailedError):
    """Blocking checks failed; holds the outcomes of all checks."""

    def __init__(self, message: str, checks: Sequence[Check]) -> None:
        """Take the message, which names the failed checks, and the outcomes of all."""
        super().__init__(message)
        self.checks = tuple(checks)


@dataclass(slots=True, kw_only=True)
class StageOutput:
    """A stage's report on its output."""

    metadata: dict[str, Scalar] = field(default_factory=dict)
    """Numbers and texts for tables and the UI, with units in the keys."""
    checks: list[Check] = field(default_factory=list)
    """Outcomes of the stage's checks."""
    previews: dict[str, str] = field(default_factory=dict)
    """Name to file of PNG pictures inside the output folder, each below 100 kB."""
    beside: list[str] = field(default_factory=list)
    """Outputs published outside its own folder, by their place below the scene's folder."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """Arguments of a stage's `run` and `check`."""

    scene: SceneEntry
    store: SceneStore
    config: RunConfig
    folder: Path
    """Empty folder to fill; published whole when `run` returns."""
    progress: Progress
    observe: Observer | None = None
    """Watches the training; its time is not counted."""
    made_from: str = ""
    """Digest by `made_from`; identifies checkpoints of the same inputs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """One step of the flow and one asset of the lineage."""

    name: str
    group: str
    """Asset group: ingest, prepare, train, synthesis, measure or export."""
    inputs: tuple[str, ...]
    """Names of the stages whose outputs it reads."""
    description: str
    """One sentence on its output, shown in the UI."""
    version: str
    """Raised when the code's output changes."""
    run: Callable[[Task], StageOutput]
    """Makes the output. Of the flow's stages this and the functions below are a `Later`."""
    per_recipe: bool = False
    """Whether recipe and seed are part of its identity and its path."""
    per_draw: bool = False
    """Whether the draw seed and the data set's label are part of its identity."""
    reads_drive: bool = False
    """Whether the content of the drive's files is part of its identity."""
    reads_views: bool = False
    """Whether the catalogue's views of the scene are part of its identity."""
    reads_truth: bool = False
    """Whether the content of the views' true images is part of its identity."""
    estimate_bytes: Callable[[Task], int] | None = None
    """Estimates what it will write, from the inputs; a disk without that space is refused before it runs."""
    check: Callable[[Task], list[Check]] | None = None
    """Checks the output in the task's folder, just made or published earlier."""
    check_version: str = ""
    """Raised when `check` changes: outputs that are up to date are then checked again, not made again."""
    tidy: Callable[[SceneStore, "Outcome", Progress], None] | None = None
    """Called once its output is published or found up to date, and the run holds no lock any more."""
    named_checks: tuple[NamedCheck, ...] = ()
    """The checks, of `run` or `check`, that the UI and the report show separately."""

    @property
    def versions(self) -> tuple[str, ...]:
        """Folder below the scene's of versions beside its output: who uses them shares the folder's lock."""
        return (self.name,) if self.per_draw else ()

    def location(self, config: RunConfig) -> str:
        """Path of its output below the scene's folder."""
        if not self.per_recipe:
            return self.name
        if self.per_draw:
            # The data sets' versions lie under the stage's name; records are kept apart from them.
            draw = f"{config.seed}-{config.draw_seed}-{config.dataset_label}"
            return f"{self.name}/.index/{config.recipe.name}/{draw}"
        return f"{self.name}/{config.recipe.name}/{config.seed}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """Result of one stage's run on one scene."""

    stage: str
    path: Path
    skipped: bool
    seconds: float
    metadata: dict[str, Scalar]
    checks: tuple[Check, ...]
    previews: dict[str, Path]
    fingerprint: str
    """SHA-256 of all that it was made from."""
    content: str
    """SHA-256 of the checksums of its files: outputs of the same content have the same one."""
    resources: dict[str, float]
    """What making it took: `peak_memory_mb`, `read_mb`, `written_mb`."""


@dataclass(frozen=True, slots=True)
class Later:
    """A function of a module that is not imported yet, called as itself: who lists stages need not wait."""

    module: str
    """Full name of the module."""
    function: str
    """Name of a function in it."""

    def load(self) -> Callable[..., Any]:
        """Import the module, unless it is, and return its function."""
        function: Callable[..., Any] = getattr(import_module(self.module), self.function)
        return function

    def __call__(self, *args: Any) -> Any:
        """Call the function."""
        return self.load()(*args)
