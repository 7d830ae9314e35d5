"""The command `nvsf`: run Dagster's jobs and reports from an installed package."""

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import click

from nvsf_core.errors import NvsfError

_TEMPLATE = "dagster.yaml"


class _Ours(click.Group):
    """A command group that shows this project's errors in one line, without a stack trace."""

    def invoke(self, ctx: click.Context) -> object:
        """Run the chosen command."""
        try:
            return super().invoke(ctx)
        except NvsfError as error:
            raise click.ClickException(str(error)) from error


@click.group(cls=_Ours, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="nvsf")
def main() -> None:
    """Recorded drive in, measured synthetic drive out.

    Outputs lie under NVSF_HOME (default: .nvsf here); NVSF_SCENES names catalogues of your own.
    """


@main.command()
def demo() -> None:
    """Write the embedded drive, train it with the recipe short, and measure what it shows."""
    sys.exit(_run_job(["demo"], "short", 0))


@main.command()
@click.argument("scenes", nargs=-1)
@click.option("--recipe", default="", help="Preset; default: the catalogue's choice, else lean.")
@click.option("--seed", default=0, show_default=True, help="Of training.")
def train(scenes: Sequence[str], recipe: str, seed: int) -> None:
    """Train SCENES (default: all that have data) from their drives to their data sets and the report."""
    sys.exit(_run_job(scenes, recipe, seed))


@main.command()
@click.argument("scene")
@click.option("--recipe", default="", help="Preset; default: the catalogue's choice, else lean.")
@click.option("--seed", default=0, show_default=True, help="Of training.")
def view(scene: str, recipe: str, seed: int) -> None:
    """Render the views that the catalogue asks of SCENE, and say where their files lie.

    What is up to date is not made again: add a [[view]] to the catalogue, and only that is new.
    """
    from nvsf_core.stages import find_scene, run_scene

    entry = find_scene(scene)
    outcomes = {one.stage: one for one in run_scene(entry, recipe=recipe or None, seed=seed)}
    for name in ("test", *(asked.name for asked in entry.views)):
        folder = outcomes["novel_views"].path / name
        click.echo(f"{name}: {folder}" if folder.is_dir() else f"{name}: not rendered")


@main.command()
def report() -> None:
    """Make the offline HTML page over everything measured under NVSF_HOME."""
    from assets.report import write_benchmark_report
    from nvsf_core.drives.catalogue import home_from_environment

    click.echo(write_benchmark_report(home_from_environment(os.environ)).path)


@main.command()
def scenes() -> None:
    """List the catalogue: which scenes have data here, and what was trained of them."""
    from nvsf_core.drives.catalogue import catalogue_from_environment, has_data, home_from_environment
    from nvsf_core.stages.runner.run import is_embedded
    from nvsf_core.stores.scene_store import published

    home = home_from_environment(os.environ)
    for entry in catalogue_from_environment(os.environ):
        trained = [folder.parent for folder in published(home / entry.name / "field", "*/*/stage.json")]
        made = ", ".join(f"{folder.parent.name} seed {folder.name}" for folder in trained) or "not trained"
        there = made if has_data(entry) or is_embedded(entry) else f"no data at {entry.root}"
        click.echo(f"{entry.name:32} frames {entry.first_frame} to {entry.last_frame}: {there}")


@main.command()
@click.argument("names", nargs=-1, metavar="[SCENES]...")
def verify(names: Sequence[str]) -> None:
    """Read every byte of SCENES anew (default: all that are trained), and say what is up to date.

    Drives and outputs are compared with what each output was made from; nothing is made. What is remembered
    of unchanged files is not believed here. Ends with 1 if an output is damaged.
    """
    from nvsf_core.drives.catalogue import catalogue_from_environment, home_from_environment
    from nvsf_core.stages import STAGES, find_scene, plan_run
    from nvsf_core.stages.runner.trained import trained_fields
    from nvsf_core.stages.runner.verify import Verdict, verify_scene

    home = home_from_environment(os.environ)
    entries = [find_scene(name) for name in names] or catalogue_from_environment(os.environ)
    damaged = False
    for entry in entries:
        for recipe, seed in trained_fields(home / entry.name):
            for found in verify_scene(plan_run(entry, home, recipe=recipe, seed=seed), STAGES):
                damaged |= found.verdict is Verdict.DAMAGED
                words = f" ({found.words})" if found.words else ""
                click.echo(f"{entry.name} {recipe} seed {seed}, {found.stage}: {found.verdict.value}{words}")
    sys.exit(1 if damaged else 0)


@main.command()
@click.option(
    "--backbone", type=click.Path(path_type=Path), help="torchvision's squeezenet1_1, if it is here."
)
@click.option("--out", type=click.Path(path_type=Path), help="File to write; default: under NVSF_HOME.")
def weights(backbone: Path | None, out: Path | None) -> None:
    """Make the weights of LPIPS from public files: the package lpips, and torchvision's SqueezeNet (5 MB)."""
    import torch

    from nvsf_core.drives.catalogue import home_from_environment
    from nvsf_core.metrics.lpips import WEIGHTS_NAME, WEIGHTS_VARIABLE
    from nvsf_core.metrics.lpips_weights import BACKBONE_URL, HEADS_PLACE, make_lpips_weights

    # The package itself needs torchvision, so it is looked into and never imported.
    package = importlib.util.find_spec("lpips")
    if package is None or package.origin is None:
        raise click.ClickException(f"the heads are missing: {sys.executable} -m pip install --no-deps lpips")
    made = out or home_from_environment(os.environ) / WEIGHTS_NAME
    made.parent.mkdir(parents=True, exist_ok=True)
    if backbone is None:
        backbone = Path(torch.hub.get_dir()) / "checkpoints" / BACKBONE_URL.rpartition("/")[2]
        try:
            torch.hub.load_state_dict_from_url(BACKBONE_URL, check_hash=True, weights_only=True)
        except (OSError, RuntimeError) as error:  # torch raises RuntimeError for another file's hash
            raise click.ClickException(
                f"{BACKBONE_URL}: {error}; fetch it and name it: --backbone"
            ) from error
    make_lpips_weights(Path(package.origin).parent / HEADS_PLACE, backbone, made)
    click.echo(f"export {WEIGHTS_VARIABLE}={made.absolute()}")


@main.command()
def doctor() -> None:
    """Say what of this machine is missing, and what that costs."""
    from pipelines.doctor import examine

    findings = examine(os.environ)
    for finding in findings:
        click.echo(f"{'ok     ' if finding.is_fine else 'MISSING'} {finding.subject}: {finding.words}")
    sys.exit(1 if any(finding.is_needed and not finding.is_fine for finding in findings) else 0)


def _run_job(scenes: Sequence[str], recipe: str, seed: int) -> int:
    """Run Dagster's job over the scenes in its own process, as `make train` does; returns its exit code."""
    from nvsf_core.drives.catalogue import home_from_environment

    home = home_from_environment(os.environ)
    chosen = {"SCENES": " ".join(scenes), "RECIPE": recipe, "SEED": str(seed), "NVSF_HOME": str(home)}
    place = Path(os.environ.get("DAGSTER_HOME") or home / "dagster").absolute()
    environment = os.environ | chosen | {
        "DAGSTER_HOME": str(place), "DAGSTER_MODULE_NAME": "pipelines.definitions",
        "PYTHONWARNINGS": "ignore:Function `job_execute_command`",
    }  # fmt: skip
    if list(scenes) == ["demo"]:
        # One process: to start one for each step takes longer than the steps of so short a drive.
        environment.setdefault("NVSF_EXECUTOR", "in_process")
    dagster = [sys.executable, "-m", "dagster"]
    if not (place / _TEMPLATE).is_file():
        place.mkdir(parents=True, exist_ok=True)
        with resources.as_file(_instance_template()) as template:
            shutil.copy(template, place / _TEMPLATE)
        # Initialise it with one process: two with an empty DAGSTER_HOME would race for its tables.
        subprocess.run([*dagster, "instance", "info"], env=environment, stdout=subprocess.DEVNULL, check=True)
    return subprocess.run([*dagster, "job", "execute", "-j", "train_all_scenes"], env=environment).returncode


def _instance_template() -> resources.abc.Traversable:
    """Configuration file of a new Dagster instance."""
    return resources.files("pipelines").joinpath(_TEMPLATE)
