"""Which fields of a scene are published."""

from collections.abc import Iterable
from pathlib import Path

from nvsf_core.errors import RecipeError
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.seed import is_seed_folder
from nvsf_core.stages.runner.record import RECORD_NAME, made_s, read_record
from nvsf_core.stores.scene_store import published


def trained_fields(scene_root: Path) -> list[tuple[str, int]]:
    """Recipe and seed of each published field below a scene's folder, the newest last; only readable ones."""
    fields = [path.parent for path in published(scene_root, f"field/*/*/{RECORD_NAME}")]
    sound = [folder for folder in fields if _is_known(folder) and read_record(folder) is not None]
    sound.sort(key=lambda folder: (made_s(folder), str(folder)))
    return [(folder.parent.name, int(folder.name)) for folder in sound]


def newest_field(
    scene_root: Path, recipe: str | None = None, seed: int | None = None
) -> tuple[str, int] | None:
    """Recipe and seed of the scene's latest published field, of those asked for; None if none is readable."""
    fields = [
        one for one in trained_fields(scene_root) if recipe in (None, one[0]) and seed in (None, one[1])
    ]
    return fields[-1] if fields else None


def newest_scene(home: Path, scenes: Iterable[str]) -> str | None:
    """Name of the scene whose field was published last; None if none has one."""
    newest = {name: newest_field(home / name) for name in scenes}
    made = {name: made_s(home / name / "field" / one[0] / str(one[1])) for name, one in newest.items() if one}
    return max(made, key=lambda name: made[name], default=None)


def _is_known(folder: Path) -> bool:
    """Whether a field's folder is named by a seed, below a preset's name."""
    try:
        preset(folder.parent.name)
    except RecipeError:
        return False
    return is_seed_folder(folder.name)
