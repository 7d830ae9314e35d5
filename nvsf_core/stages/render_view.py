"""Render one view of a scene and write its data set: what a `[[view]]` of the catalogue does, as a call."""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from nvsf_core.drives.catalogue import SceneEntry, home_from_environment, sensors_from_environment
from nvsf_core.drives.catalogue_views import read_view
from nvsf_core.drives.drive import own_folders, require_outside
from nvsf_core.drives.view_entry import ViewEntry
from nvsf_core.errors import DataError, StoreError
from nvsf_core.recipe.base import Recipe
from nvsf_core.stages.dataset import dataset_version, failed_checks, identity_of, is_there, source_checksums
from nvsf_core.stages.exports.of_view import RenderedView
from nvsf_core.stages.exports.write import finish_data_set, write_data_set
from nvsf_core.stages.field import load_trained
from nvsf_core.stages.flow import FIELD
from nvsf_core.stages.inputs import clock_origin_s, read_recording
from nvsf_core.stages.kept_versions import keep_newest
from nvsf_core.stages.novel_views import asks_images, render_view_arrays, say_tilted, with_images
from nvsf_core.stages.runner.locks import LOCKS, file_lock, output_locks
from nvsf_core.stages.runner.own_places import require_place_of_yours
from nvsf_core.stages.runner.run import (
    SceneRun,
    find_scene,
    plan_run,
    run_named_stage,
    say_on_stderr,
    write_demo_where_absent,
)
from nvsf_core.stages.runner.stage import Progress
from nvsf_core.stages.versions import reading_versions
from nvsf_core.stages.views.instances import boxes_of, instance_arrays
from nvsf_core.stages.views.view import asked_view, camera_models, placed, view_attrs
from nvsf_core.stores.removal import carry_pin
from nvsf_core.stores.scene_store import new_folder

_MODEL = "model"
_BEFORE = ("frames", "sweeps", "pano", "undistorted", "evidence", "field")
"""Stages whose outputs a view needs; those that are up to date are skipped."""


def view_of(keys: Mapping[str, Any], home: Path | None = None) -> ViewEntry:
    """A view from the keys that a `[[view]]` of the catalogue has; without a name it is `view`.

    A `sensor` may be one of the catalogue's own; a relative `pose_file` lies in the current folder.

    Args:
        keys: Keys and values as TOML has them.
        home: Folder for `$NVSF_HOME` in a path; default NVSF_HOME.

    Raises:
        DataError: A key is unknown or of the wrong kind, or what is asked for is impossible.
    """
    folder = home_from_environment(os.environ) if home is None else home
    sensors = sensors_from_environment(os.environ) if isinstance(keys.get("sensor"), str) else {}
    return read_view({"name": "view", **keys}, "view", Path(), folder, sensors)


# Wide: each is a choice of its own; all but the first two have defaults.
def render_view(
    scene: str | SceneEntry,
    view: ViewEntry | Mapping[str, Any],
    home: Path | str | None = None,
    *,
    out: Path | str | None = None,
    recipe: str | Recipe | None = None,
    seed: int = 0,
    draw_seed: int = 0,
    progress: Progress | None = None,
) -> Path:
    """Render a view of a scene by its trained model, and write it as a data set.

    A scene that is not trained yet is trained first. Nothing of it, nor of its other views, is changed.

    Args:
        scene: A catalogue entry, or its name.
        view: What to render: a `ViewEntry`, or the keys of a `[[view]]`.
        home: Folder of all outputs; default NVSF_HOME, else `.nvsf` in the working directory.
        out: Folder to make; default `dataset/<view>/<version>` of the scene, as the stage `dataset` names it.
        recipe: A preset's name or a recipe; default the catalogue's choice, else `lean`.
        seed: Seed of training.
        draw_seed: Seed of ray drop and range noise.
        progress: Receives progress lines; default standard error.

    Returns:
        The folder of the data set, with its `manifest.json` and its card.

    Raises:
        DataError: The view asks for what is impossible, or `out` is taken, in the drive, or belongs to the
            outputs in the home; found before anything is trained.
        StoreError: The disk refused what was to be written.
        NvsfError: A stage failed.
    """
    entry = find_scene(scene) if isinstance(scene, str) else scene
    place = Path(home) if home else home_from_environment(os.environ)
    asked = view if isinstance(view, ViewEntry) else view_of(view, place)
    say = progress or say_on_stderr
    target = None if out is None else Path(out)
    if target is not None and target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise DataError(f"out: expected no {target}, or an empty folder, found one with files; name another")
    if target is not None:
        require_outside(target, own_folders(entry))
        require_place_of_yours(target, place)
    run = plan_run(
        replace(entry, views=(asked,)), place, recipe=recipe, seed=seed, draw_seed=draw_seed
    )  # fmt: skip
    write_demo_where_absent(entry, say)
    for name in _BEFORE:
        run_named_stage(name, run, say)
    # Nobody replaces what is read below; the field's place depends on recipe and seed.
    read = [*_BEFORE[:-1], FIELD.location(run.config)]
    try:
        with output_locks(place / LOCKS / entry.name, None, read, say):
            return _data_set(run, asked, target, say)
    except OSError as error:
        refused = target or error.filename or run.store.root
        raise StoreError(
            f"cannot write {refused} ({error.strerror or error}); check space and rights"
        ) from error


def _data_set(run: SceneRun, asked: ViewEntry, target: Path | None, say: Progress) -> Path:
    """Write the data set of a view whose model and drive nobody replaces meanwhile."""
    if target is not None:
        with new_folder(target) as folder:
            _write(run, asked, folder, say)
        _say_doubts(run.scene.name, target, say)
        return target
    home, scene = run.store.home, run.scene.name
    task = run.task(home, say)
    location = f"dataset/{asked.name}/{dataset_version(task, asked, source_checksums(task))}"
    lock = file_lock(home / LOCKS / scene / f"{location}.lock", say, f"{location} of another run")
    with reading_versions(home, [scene], say), lock:
        if not is_there(task, location):
            with run.store.publish(location) as folder:
                _write(run, asked, folder, say)
                carry_pin(run.store.path(location), folder)
    _say_doubts(scene, run.store.path(location), say)
    keep_newest(run.store, [location], say)
    return run.store.path(location)


def _say_doubts(scene: str, folder: Path, say: Progress) -> None:
    """Say which checks the data set fails: the stage `dataset`, which records them, is not run."""
    for check in failed_checks(folder):
        say(f"[{scene}] view: check {check.name} fails: {check.detail}")


def _write(run: SceneRun, asked: ViewEntry, folder: Path, say: Progress) -> None:
    task = run.task(folder, say)
    recording = read_recording(run.store)
    view = asked_view(recording, asked)
    say_tilted(task, asked)
    if view is None:
        raise DataError(
            f"view {asked.name}: expected sensors that the drive has, found none of those asked for"
        )
    has_images = bool(view.images or view.other_cameras)
    model = load_trained(run.store.require(FIELD.location(run.config)), recording, with_camera=has_images)
    models, _ = with_images(task, recording, {_MODEL: model}, [view])
    model = models[_MODEL]
    arrays = render_view_arrays(task, recording, view, model, _MODEL) | placed(recording, view)
    attrs = view_attrs(recording, view, by_images=asks_images(recording, view, model))
    boxes = boxes_of(run.store)
    instances, attrs["instances"] = instance_arrays(arrays, camera_models(attrs), boxes)
    arrays |= instances
    rendered = RenderedView(
        scene=run.scene.name, sequence=run.scene.sequence, entry=asked, config=run.config, arrays=arrays,
        attrs=attrs, origin_s=clock_origin_s(run.store),
    )  # fmt: skip
    sources = source_checksums(task)
    manifest = {
        **identity_of(task, asked, dataset_version(task, asked, sources)),
        "drawn": rendered.what_was_sampled(),
        "source_checksums": sources,
        **write_data_set(folder, rendered, boxes),
    }
    finish_data_set(folder, manifest)
