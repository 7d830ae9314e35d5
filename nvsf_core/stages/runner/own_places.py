"""Places in NVSF_HOME where stages and Dagster replace and remove what lies there."""

from pathlib import Path

from nvsf_core.errors import DataError
from nvsf_core.names import RESERVED_SCENES
from nvsf_core.stages.flow import STAGE_NAMES

_DRIVES = "drives"
"""The one folder of a home that is the user's."""


def require_place_of_yours(out: Path, home: Path) -> None:
    """Refuse a folder that somebody names for a drive or a data set and that the project would remove later.

    Args:
        out: The folder to make.
        home: Folder of all outputs; a link counts as what it leads to.

    Raises:
        DataError: It lies in a hidden folder of the home, in the report's or Dagster's, or in a hidden or a
            stage's folder of a scene.
    """
    home = home.resolve()
    if not out.resolve().is_relative_to(home):
        return
    first, *rest = [*out.resolve().relative_to(home).parts, ""]
    if first == _DRIVES:
        return
    is_ours = first.startswith(".") or first in RESERVED_SCENES
    if is_ours or (rest and (rest[0].startswith(".") or rest[0] in STAGE_NAMES)):
        raise DataError(
            f"{out}: expected a folder of your own, found a place of NVSF_HOME={home} whose content is "
            f"replaced and removed by runs; name a folder elsewhere, or for a drive {home / _DRIVES / 'NAME'}"
        )
