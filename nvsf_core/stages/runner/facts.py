"""What decides a stage's output, its fingerprint, and the words for what has changed."""

from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.drives.entries import ViewEntry
from nvsf_core.stages.runner.contents import drive_digest, truth_digest
from nvsf_core.stages.runner.stage import RunConfig, Stage
from nvsf_core.stores.checksums import json_digest
from nvsf_core.stores.file_hashes import FileHashes

Facts = dict[str, Any]
"""All that decides an output, as JSON holds it."""

_NOT_OF_SCENE = ("root", "views", "recipe", "licence", "compensate")
"""Where a drive lies decides nothing; its content, its views, the recipe and, for data sets, the licence are
facts of their own. Whether scans are compensated depends on the kind of the drive, too."""
_NOT_OF_VIEW = ("scenes", "truth")
"""Other scenes of a view decide nothing; of its truth only the cameras do, and the images' content."""
_WORDS = {
    "version": "the stage's code",
    "scene": "the scene's entry in the catalogue",
    "recipe": "the recipe",
    "seed": "the seed",
    "draw": "the draw seed or the label of the data set",
    "views": "the views that the catalogue asks for",
    "licence": "the licence of the recording",
    "drive": "the files of the drive",
    "truth": "the true images of its views",
}
_MOST_NAMED = 4


def facts_of(
    stage: Stage, scene: SceneEntry, config: RunConfig, inputs: Mapping[str, str], hashes: FileHashes
) -> Facts:
    """All that decides the output: code version, content of the inputs, scene, recipe and seeds.

    A key of the catalogue that has its default is left out: a new key changes no earlier fingerprint.

    Args:
        stage: The stage.
        scene: The scene.
        config: Recipe and seeds.
        inputs: Name of each input stage to the content of its output.
        hashes: Of the recorded files.

    Raises:
        DataError: A recorded file cannot be read, or a view's true image is absent.
        TimeIsUpError: The time of `hashes` is up.
    """
    facts: Facts = {
        "stage": stage.name,
        "version": stage.version,
        "inputs": {name: inputs[name] for name in sorted(stage.inputs)},
        "scene": scene_facts(scene),
    }
    if stage.per_recipe:
        facts["recipe"] = config.recipe.identity()
        facts["seed"] = config.seed
    if stage.per_draw:
        facts["draw"] = [config.draw_seed, config.dataset_label]
        if scene.licence is not None:
            facts["licence"] = scene.licence
    if stage.reads_views:
        facts["views"] = view_facts(scene)
    if stage.reads_drive:
        facts["drive"] = drive_digest(scene, hashes)
    if stage.reads_truth:
        facts["truth"] = truth_digest(scene, hashes)
    return facts


def scene_facts(scene: SceneEntry) -> Facts:
    """What a scene's entry in the catalogue decides, its views and its recipe left out."""
    facts = _not_default(scene, _NOT_OF_SCENE)
    return facts if scene.is_to_compensate else facts | {"compensate": False}


def view_facts(scene: SceneEntry) -> list[Facts]:
    """What the entries of the scene's views decide."""
    return [
        _not_default(view, _NOT_OF_VIEW) | ({"truth": [name for name, _ in view.truth]} if view.truth else {})
        for view in scene.views
    ]


def drive_version(scene: SceneEntry, hashes: FileHashes) -> str:
    """Digest of a recorded drive as the scene uses it: its files, and its entry in the catalogue.

    Raises:
        DataError: A file cannot be read.
        TimeIsUpError: The time of `hashes` is up.
    """
    return json_digest({"scene": scene_facts(scene), "drive": drive_digest(scene, hashes)})


def views_version(scene: SceneEntry, hashes: FileHashes) -> str:
    """Digest of the views that the catalogue asks of a scene, and of their true images.

    Raises:
        DataError: A true image is absent or cannot be read.
        TimeIsUpError: The time of `hashes` is up.
    """
    return json_digest({"views": view_facts(scene), "truth": truth_digest(scene, hashes)})


def without_recipe(facts: Facts) -> str:
    """SHA-256 of all facts but the recipe."""
    return json_digest({name: fact for name, fact in facts.items() if name != "recipe"})


def difference(before: Mapping[str, Any], now: Facts) -> str:
    """What has changed between two records' facts, in words."""
    changed = [name for name in now if before.get(name) != now[name]]
    named = [words for name in changed for words in _changed(name, before.get(name), now[name])]
    return ", ".join(named[:_MOST_NAMED]) + (", ..." if len(named) > _MOST_NAMED else "") or "what it reads"


def _changed(name: str, before: Any, now: Any) -> Iterable[str]:
    if name == "inputs":
        old = before if isinstance(before, dict) else {}
        return [f"its input {source}" for source in now if old.get(source) != now[source]]
    if name == "version":
        return [f"{_WORDS[name]} (version {before!s:.20}, now {now})"]
    if name == "scene" and isinstance(before, dict):
        keys = sorted(key for key in {*before, *now} if before.get(key) != now.get(key))
        return [f"{_WORDS[name]} ({', '.join(keys)!s:.100})"]
    return [_WORDS.get(name, name)]


def _not_default(entry: SceneEntry | ViewEntry, left_out: tuple[str, ...]) -> Facts:
    return {
        one.name: _plain(getattr(entry, one.name))
        for one in fields(entry)
        if one.name not in left_out and getattr(entry, one.name) != one.default
    }


def _plain(value: Any) -> Any:
    """A value as JSON gives it back; a part of a view, as a camera, without its defaults."""
    if is_dataclass(value):
        return {
            one.name: _plain(getattr(value, one.name))
            for one in fields(value)
            if getattr(value, one.name) != one.default
        }
    return [_plain(one) for one in value] if isinstance(value, tuple) else value
