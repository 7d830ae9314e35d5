"""What a stored file holds, by name: asking for a name that it lacks says so in the store's own words."""

from pathlib import Path
from typing import Any, NoReturn, TypeVar

from nvsf_core.errors import StoreError

_Value = TypeVar("_Value")


class Contents(dict[str, _Value]):
    """A dict whose `[name]` raises a StoreError for an absent name; a KeyError would name no file."""

    __slots__ = ("path",)

    def __init__(self, path: Path, *named: Any) -> None:
        """Hold what `dict` takes, read from `path`."""
        super().__init__(*named)
        self.path = path

    def __missing__(self, name: str) -> NoReturn:
        """Refuse.

        Raises:
            StoreError: Names the file, what it has, and what to delete.
        """
        raise foreign(self.path, f"expected {name!r}, found {', '.join(sorted(self)[:40]) or 'nothing'}")


def foreign(path: Path, found: str) -> StoreError:
    """The error of a stored file that is damaged, or not what this project writes.

    Args:
        path: The file or group; its folder is the output that is to be made anew.
        found: What was expected of it and what was found.
    """
    return StoreError(f"{path}: {found}; delete {path.parent} and run again: it is then made anew")
