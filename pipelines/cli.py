"""The command `nvsf`: run Dagster's jobs and reports from an installed package."""

import importlib.util
import os
import shlex
import sys
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click

from nvsf_core.drives.entries import ViewEntry
from nvsf_core.errors import DataError, NvsfError
from nvsf_core.names import printable

# What an argument says wins; else the variable that `make` and Dagster read, too; else the default.
_recipe_option = click.option(
    "--recipe", default="", envvar="RECIPE", show_envvar=True,
    help="Preset; default: the catalogue's choice, else lean.",
)  # fmt: skip
_seed_option = click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    envvar="SEED",
    show_envvar=True,
    show_default=True,
    help="Of training.",
)


_own_recipe_option = click.option(
    "--recipe",
    default="",
    envvar="RECIPE",
    show_envvar=True,
    help="Of training; default: of the newest field.",
)
_own_seed_option = click.option(
    "--seed", type=click.IntRange(min=0), envvar="SEED", show_envvar=True,
    help="Of training; default: of the newest field.",
)  # fmt: skip


class _Ours(click.Group):
    """A command group that shows this project's errors in one line, without a stack trace."""

    def invoke(self, ctx: click.Context) -> object:
        """Run the chosen command."""
        try:
            return super().invoke(ctx)
        except NvsfError as error:
            raise click.ClickException(printable(error)) from error
        except BrokenPipeError:
            raise  # who reads the words has gone: click ends without a word
        except OSError as error:
            raise click.ClickException(printable(_refused(error))) from error


def _refused(error: OSError) -> str:
    """What could not be read or written, why, and what to do."""
    if isinstance(error, PermissionError):
        return f"cannot use {error.filename} ({error.strerror}); correct its owner or permissions"
    # A write that the disk refuses names no file.
    place = error.filename or f"a file, with NVSF_HOME={os.environ.get('NVSF_HOME') or '.nvsf'}"
    return f"cannot use {place} ({error.strerror or error}); check space and name"


def _say(line: object, *, err: bool = False) -> None:
    """Write a line; all words that stem from drives and catalogues go this way to the terminal."""
    click.echo(printable(line), err=err)


@click.group(cls=_Ours, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="nvsf")
def main() -> None:
    """Recorded drive in, measured synthetic drive out.

    Outputs lie under NVSF_HOME (default: .nvsf here); NVSF_SCENES names catalogues of your own.
    """


@main.command()
def demo() -> None:
    """Write the embedded drive, train it with the recipe short, and measure what it shows."""
    from pipelines.job_process import run_job

    sys.exit(run_job(["demo"], "short", 0))


@main.command()
@click.argument("scenes", nargs=-1, envvar="SCENES")
@_recipe_option
@_seed_option
def train(scenes: Sequence[str], recipe: str, seed: int) -> None:
    """Train SCENES from their drives to their data sets and the report.

    By default those that the variable SCENES names, separated by blanks, else all that have data.
    """
    from pipelines.job_process import run_job

    sys.exit(run_job(scenes, recipe, seed))


@main.command()
@click.argument("scene", required=False)
@click.argument("keys", nargs=-1)
@click.option("--check", is_flag=True, help="Only say whether the views can be made, and what they are.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the one view that KEYS ask for.")
@_own_recipe_option
@_own_seed_option
def view(
    scene: str | None, keys: Sequence[str], check: bool, out: Path | None, recipe: str, seed: int | None
) -> None:
    """Render the views that the catalogue asks of SCENE (default: trained last), or the one KEYS ask for.

    KEYS are lines of a [[view]], as 'shift_m = [0, 1, 0]' 'sensor = "VLP-16"' (docs/catalogue.md); it
    becomes a data set. What is up to date is not made again: add a [[view]] to the catalogue, and only that
    is new.

    \f
    Args:
        scene: Name in the catalogue; none = all, for `check`, else the one that was trained last.
        keys: Lines of TOML.
        check: Whether only to say what can be made.
        out: Folder of the data set.
        recipe: A preset's name; empty = that of the scene's newest field, if it has one.
        seed: Of training; None = that of the scene's newest field, else 0.
    """  # noqa: D301  click ends its help at a real form feed, which a raw docstring has not
    from nvsf_core.stages import find_scene, run_scene
    from nvsf_core.stages.render_view import render_view, view_of

    asked = _keys(keys)
    if check:
        for line in _checked(scene, view_of(asked) if asked else None):
            _say(line)
        return
    scene, trained = _chosen(scene, recipe or None, seed)
    if asked:
        _say(render_view(scene, asked, out=out, **trained))
        return
    if out is not None:
        raise click.UsageError("--out is for the view that KEYS ask for; the catalogue's lie under NVSF_HOME")
    entry = find_scene(scene)
    outcomes = {one.stage: one for one in run_scene(entry, **trained)}
    for name in ("test", *(one.name for one in entry.views)):
        folder = outcomes["novel_views"].path / name
        _say(f"{name}: {folder}" if folder.is_dir() else f"{name}: not rendered")


def _chosen(scene: str | None, recipe: str | None, seed: int | None) -> tuple[str, dict[str, Any]]:
    """The scene, and recipe and seed of its training: of the newest field where nothing else is asked for."""
    from nvsf_core.drives.catalogue import catalogue_from_environment, home_from_environment
    from nvsf_core.stages.runner.trained import newest_field, newest_scene

    home = home_from_environment(os.environ)
    name = scene or newest_scene(home, [entry.name for entry in catalogue_from_environment(os.environ)])
    if name is None:
        raise click.UsageError("nothing is trained yet: name a SCENE; `nvsf scenes` lists them")
    newest = newest_field(home / name, recipe, seed)
    if newest is None:
        return name, {"recipe": recipe, "seed": seed or 0}
    if (scene, recipe, seed) != (name, *newest):
        _say(f"of {name}, recipe {newest[0]}, seed {newest[1]}, its newest field", err=True)
    return name, {"recipe": newest[0], "seed": newest[1]}


def _keys(lines: Sequence[str]) -> dict[str, Any]:
    """Keys of a view from lines of TOML."""
    try:
        return tomllib.loads("\n".join(lines))
    except tomllib.TOMLDecodeError as error:
        raise click.UsageError(
            f"expected KEYS as lines of TOML, as 'shift_m = [0, 1, 0]': {error}"
        ) from error


def _checked(scene: str | None, asked: ViewEntry | None) -> Iterator[str]:
    """A line for each view of a scene, or of all that have data; a mistake is raised."""
    from nvsf_core.drives.catalogue import catalogue_from_environment
    from nvsf_core.drives.drive import has_data, why_no_data
    from nvsf_core.drives.view_checks import described
    from nvsf_core.drives.view_truth import require_truth
    from nvsf_core.stages import find_scene
    from nvsf_core.stages.runner.run import is_embedded

    entries = [find_scene(scene)] if scene else catalogue_from_environment(os.environ)
    there = [entry for entry in entries if has_data(entry) or is_embedded(entry)]
    absent = [entry for entry in entries if entry not in there]
    for entry in there:
        chosen = entry if asked is None else replace(entry, views=(asked,))
        require_truth(chosen)
        lines = described(chosen) or ["no view is asked for but `test`: add a [[view]], or give KEYS"]
        yield from (f"{entry.name}, {line}" for line in lines)
    if absent and scene:
        raise DataError(f"{scene}: not checked, no data at {absent[0].root}: {why_no_data(absent[0])}")
    if absent:
        yield f"not checked, no data here: {', '.join(entry.name for entry in absent)}"


@main.command(name="import")
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the drive to make.")
@click.option("--layout", default="plain", show_default=True, help="plain, or kitti360.")
@click.option("--name", default="", help="Of the scene; default: that of SOURCE.")
@click.option("--kind", default="", help="Format of SOURCE; default: as it looks.")
@click.option("--sequence", default="", help="Of several in SOURCE, the one to take.")
@click.option("--first", type=int, help="First frame; default: the first there is.")
@click.option("--last", type=int, help="Last frame; default: the last there is.")
@click.option("--lidar", help="The LiDAR's name, or `found`; default: as SOURCE says.")
@click.option("--topic", help="Of a bag with several topics of point clouds, the one to read.")
@click.option("--sweep-period", type=float, metavar="SECONDS", help="Of one sweep; default: as SOURCE says.")
@click.option("--rectified", multiple=True, metavar="CAMERA", help="Of a bag, one of rectified images.")
def import_(
    source: Path,
    out: Path,
    layout: str,
    first: int | None,
    last: int | None,
    sweep_period: float | None,
    rectified: tuple[str, ...],
    **named: str,
) -> None:
    """Convert the recording SOURCE into a drive that trains here: plain files, or KITTI-360's layout.

    Reads ROS 1 and 2 bags, MCAP, KITTI odometry and raw, KITTI-360, and plain files (docs/drives.md). A scan
    or image that cannot be used is named and left out; a drive without poses gets them by KISS-ICP. The
    folder has a catalogue of its own: NVSF_SCENES=DRIVE/scenes.toml.

    \f
    Args:
        source: The recording.
        out: Folder of the drive.
        layout: `plain` or `kitti360`.
        first: First frame; None = the first there is.
        last: Last frame; None = the last there is.
        sweep_period: Duration of a sweep, and time from frame to frame where there are no times; None = as
            the recording says.
        rectified: Cameras of a bag whose images are rectified already.
        named: `name`, `kind`, `sequence`, `lidar` and `topic`.
    """  # noqa: D301  as of `view`
    from nvsf_core.drives.detect import kind_of, whole_drive
    from nvsf_core.stages.imports.convert import import_drive
    from nvsf_core.stages.runner.heartbeat import sparse
    from nvsf_core.stages.runner.run import say_on_stderr

    kind = named["kind"] or kind_of(source)
    scene = whole_drive(source, kind, named["sequence"], named["lidar"], first, last, named["topic"])
    name = named["name"] or scene.name
    scene = replace(scene, name=name, rectified=rectified, sweep_period_s=sweep_period)
    done = import_drive(scene, out, layout=layout, progress=sparse(say_on_stderr))
    for line in (*done.left_out, *done.notes):
        _say(line)
    catalogue = shlex.quote(str(done.folder.absolute() / "scenes.toml"))
    _say(
        f"{done.folder}: {done.scans} scans, {done.images} images, {done.frames} poses of frames "
        f"{scene.first_frame} to {scene.last_frame}; {len(done.left_out)} left out, named in import.json; "
        f"export NVSF_SCENES={catalogue}"
    )


@main.command()
@click.argument("scene")
@click.argument("view")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the data set to make.")
@click.option("--recipe", help="Of the parts' data sets; default: of the newest ones.")
@click.option("--seed", default=0, show_default=True, help="Of training.")
def join(scene: str, view: str, out: Path, recipe: str | None, seed: int) -> None:
    """Join the data sets of VIEW of all parts of SCENE, a scene with `cut_frames`.

    \f
    Args:
        scene: The scene that was cut.
        view: Name of a view, or `test`.
        out: Folder of the data set.
        recipe: A preset's name; None = that of the newest ones.
        seed: Of training.
    """  # noqa: D301  as of `view`
    from nvsf_core.drives.catalogue import catalogue_from_environment, home_from_environment
    from nvsf_core.drives.cuts import parts_of
    from nvsf_core.stages.exports.join import asks_for, join_data_sets, newest_data_set
    from nvsf_core.stages.versions import reading_versions

    parts = parts_of(scene, catalogue_from_environment(os.environ))
    home = home_from_environment(os.environ)
    names = [part.name for part, _ in parts]
    with reading_versions(home, names, partial(_say, err=True)):
        # Of a view that the catalogue has no more, all parts are asked.
        asked = [part.name for part, _ in parts if asks_for(part, view)] or names
        folders = [
            newest_data_set(home, name, view, recipe, seed) if name in asked else None for name in names
        ]
        _say(join_data_sets(scene, parts, folders, out))


@main.command()
def report() -> None:
    """Make the offline HTML page over everything measured under NVSF_HOME."""
    from assets.report import scenes_without_data, write_benchmark_report
    from nvsf_core.drives.catalogue import home_from_environment

    home = home_from_environment(os.environ)
    _say(write_benchmark_report(home, scenes_without_data(home)))


@main.command()
def scenes() -> None:
    """List the catalogue: which scenes have data here, and what was trained of them."""
    from nvsf_core.drives.catalogue import catalogue_from_environment, home_from_environment
    from nvsf_core.drives.drive import has_data
    from nvsf_core.stages.runner.run import is_embedded
    from nvsf_core.stages.runner.same_drive import other_root
    from nvsf_core.stores.scene_store import SceneStore, published

    home = home_from_environment(os.environ)
    for entry in catalogue_from_environment(os.environ):
        try:
            trained = [folder.parent for folder in published(home / entry.name / "field", "*/*/stage.json")]
            made = (
                ", ".join(f"{folder.parent.name} seed {folder.name}" for folder in trained) or "not trained"
            )
            elsewhere = other_root(SceneStore(home, entry.name), entry) if trained else None
            made += f", of the drive that lay at {elsewhere}" if elsewhere else ""
            there = made if has_data(entry) or is_embedded(entry) else f"no data at {entry.root}"
        except NvsfError as error:
            there = str(error)
        except PermissionError as error:
            there = _refused(error)
        _say(f"{entry.name:32} frames {entry.first_frame} to {entry.last_frame}: {there}")


@main.command()
@click.argument("names", nargs=-1, metavar="[SCENES]...")
@click.option(
    "--mend", is_flag=True, help="Make damaged data sets anew, where nothing of theirs has changed."
)
def verify(names: Sequence[str], mend: bool) -> None:
    """Read every byte of SCENES anew (default: all with outputs here), and say what is up to date.

    Drives and outputs are compared with what each output was made from, all versions of data sets with their
    manifests. What is remembered of unchanged files is not believed here. Nothing is made but by --mend:
    other damaged outputs are made anew by the next run. Ends with 1 if something is damaged, or if nothing of
    one of SCENES could be verified.
    """
    from pipelines.verify import verify_scenes

    sys.exit(0 if verify_scenes(names, mend, _say) else 1)


@main.command()
@click.option(
    "--backbone", type=click.Path(path_type=Path), help="torchvision's squeezenet1_1, if it is here."
)
@click.option("--out", type=click.Path(path_type=Path), help="File to write; default: under NVSF_HOME.")
def weights(backbone: Path | None, out: Path | None) -> None:
    """Make the weights of LPIPS from public files: the package lpips, and torchvision's SqueezeNet (5 MB)."""
    import torch

    from nvsf_core.drives.catalogue import home_from_environment
    from nvsf_core.metrics.lpips_file import WEIGHTS_NAME, WEIGHTS_VARIABLE
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
    _say(f"export {WEIGHTS_VARIABLE}={shlex.quote(str(made.absolute()))}")


@main.command()
def doctor() -> None:
    """Say what of this machine is missing, and what that costs."""
    from pipelines.doctor.findings import examine

    findings = examine(os.environ)
    for finding in findings:
        _say(f"{'ok     ' if finding.is_fine else 'MISSING'} {finding.subject}: {finding.words}")
    sys.exit(1 if any(finding.is_needed and not finding.is_fine for finding in findings) else 0)
