"""What `nvsf verify` reads anew, what it finds, and what it cannot compare with anything."""

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from nvsf_core.drives.catalogue import SceneEntry, catalogue_from_environment, home_from_environment
from nvsf_core.names import RESERVED_SCENES, name_fault
from nvsf_core.recipe.presets import preset
from nvsf_core.stages import STAGES, RunConfig, SceneRun, find_scene
from nvsf_core.stages.runner.run import say_on_stderr
from nvsf_core.stages.runner.trained import trained_fields
from nvsf_core.stages.runner.verify import Verdict, verify_scene
from nvsf_core.stages.versions import VERSIONS, damage_at_rest, make_anew, versions_of
from nvsf_core.stores.removal import removal_of, removals
from nvsf_core.stores.scene_store import SceneStore

Say = Callable[[str], None]


def verify_scenes(names: Sequence[str], mend: bool, say: Say) -> bool:
    """Verify scenes; returns whether all that was read is sound, and something of each of them was read.

    Args:
        names: Names in the catalogue; none = all that have outputs below the home.
        mend: Whether to make damaged data sets anew.
        say: Receives a line for each output, and for each scene of which nothing was verified.

    Raises:
        DataError: The catalogue has no scene of such a name.
    """
    home = home_from_environment(os.environ)
    entries = [find_scene(name) for name in names] or catalogue_from_environment(os.environ)
    is_sound, read = True, 0
    for entry in entries:
        sound = [*_outputs(entry, home, say), *_versions(entry, home, mend, say)]
        is_sound &= all(sound)
        read += len(sound)
        if not sound and (names or (home / entry.name).is_dir()):
            is_sound = False
            say(f"{entry.name}: NOT VERIFIED: no trained field of it that can be read lies under {home}")
    for name in () if names else _trained_of_no_catalogue(home, [entry.name for entry in entries]):
        is_sound = False
        say(
            f"{name}: NOT VERIFIED: trained under {home}, and no scene of the catalogue, which names the "
            "drives; NVSF_SCENES names other catalogues"
        )
    if not read:
        say(f"nothing was verified: no scene of the catalogue is trained under {home}")
    return is_sound


def _trained_of_no_catalogue(home: Path, known: Sequence[str]) -> Iterator[str]:
    for folder in sorted(home.iterdir()) if home.is_dir() else []:
        is_scene = name_fault(folder.name, RESERVED_SCENES) is None and not folder.is_symlink()
        if is_scene and folder.name not in known and trained_fields(folder):
            yield folder.name


def _outputs(entry: SceneEntry, home: Path, say: Say) -> Iterator[bool]:
    """Whether each output of a scene's trained recipes and seeds is sound."""
    for recipe, seed in trained_fields(home / entry.name):
        # What a view asks for may not be had here any more: what is made can be read all the same.
        config = RunConfig(recipe=preset(recipe), seed=seed)
        run = SceneRun(scene=entry, store=SceneStore(home.resolve(), entry.name), config=config)
        for found in verify_scene(run, STAGES):
            words = f" ({found.words})" if found.words else ""
            say(f"{entry.name} {recipe} seed {seed}, {found.stage}: {found.verdict.value}{words}")
            yield found.verdict is not Verdict.DAMAGED


def _versions(entry: SceneEntry, home: Path, mend: bool, say: Say) -> Iterator[bool]:
    """Whether each version of a scene's data sets is whole, or was made anew."""
    store = SceneStore(home, entry.name)
    for version in versions_of(store):
        damage = damage_at_rest(store, version, say_on_stderr)
        if damage is not None and removal_of(store, version.location) is not None:
            continue  # removed while it was read; told below
        is_mended = damage is not None and mend and make_anew(entry, home, version, say_on_stderr)
        reason = "; not made anew, for its model, its drive or the code has changed since" if mend else ""
        words = "whole" if damage is None else "made anew" if is_mended else f"DAMAGED ({damage}){reason}"
        say(f"{entry.name}, {version.location}: {words}")
        yield damage is None or is_mended
    for one in removals(store, f"{VERSIONS}/*/*"):
        say(f"{entry.name}, {one.place}: {one.words}")
