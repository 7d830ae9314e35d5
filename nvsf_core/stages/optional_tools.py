"""Tools that an output is made without where they are absent; it is made again once they are there.

They are no part of an output's fingerprint: what was made with all of them keeps it. The record of what was
made without one says so, in the words that the user reads; those are looked for here.
"""

from collections.abc import Callable, Iterable

from nvsf_core.clouds.odometry import NO_KISS_ICP, load_kiss_icp
from nvsf_core.clouds.open3d_room import NO_OPEN3D, load_open3d
from nvsf_core.errors import MissingLibraryError, StoreError
from nvsf_core.metrics.lpips_file import NO_WEIGHTS, find_weights

_TOOLS: tuple[tuple[str, str, Callable[[], object]], ...] = (
    ("open3d", NO_OPEN3D, load_open3d),
    ("KISS-ICP", NO_KISS_ICP, load_kiss_icp),
    ("the weights of LPIPS", NO_WEIGHTS, find_weights),
)
"""Name of each tool, what a record says where it was absent, and what finds it, as the stage itself does."""


def tools_now_there(said: Iterable[object]) -> list[str]:
    """Names of the tools whose absence is named in a record's texts, and that are there now.

    A tool that no text names is not looked for, so that nothing is loaded for outputs made with all of them.
    """
    texts = [text for text in said if isinstance(text, str)]
    return [name for name, words, find in _TOOLS if any(words in text for text in texts) and _is_there(find)]


def _is_there(find: Callable[[], object]) -> bool:
    try:
        return find() is not None
    except (MissingLibraryError, StoreError):
        return False
