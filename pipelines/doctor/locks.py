"""Examine whether the home's file system locks files, and whether its locks hold between machines."""

import fcntl
import re
import tempfile
from pathlib import Path

_OWN_LOCKS = re.compile(r"\b(nolock|nobrl|local_lock=(?:flock|all))\b")
"""Options of a mount by which each machine knows its own locks alone."""
_SHARED = ("nfs", "cifs", "smb", "ceph", "lustre", "gpfs", "gfs2", "ocfs2", "glusterfs", "9p", "virtiofs")
"""How the kinds of file systems begin that several machines may use."""
_ESCAPED = re.compile(r"\\([0-7]{3})")


def examine_locks(folder: Path, mounts: Path = Path("/proc/self/mounts")) -> tuple[bool, str]:
    """Whether two runs wait for each other in a folder, and what was found.

    Between machines this cannot be seen from one of them: the words say how to try it.

    Args:
        folder: A folder that exists; a temporary one is made in it.
        mounts: The kernel's table of mounts.
    """
    kind, options = mount_of(folder, mounts)
    refused = _refused(folder)
    if refused:
        return False, f"{folder} ({kind}): {refused}; two runs of a scene would mix their files"
    own = _OWN_LOCKS.search(options)
    if own is not None:
        return False, (
            f"{folder} ({kind}, {own[1]}): locks hold within this machine only; let each scene be made by "
            "one machine, or mount it without that option"
        )
    if kind.removeprefix("fuse.").startswith(_SHARED):
        return True, f"{kind}: files are locked; deploy/README.md says how to try it from two machines"
    return True, f"{kind}: files are locked"


def mount_of(folder: Path, mounts: Path) -> tuple[str, str]:
    """Kind and options of the file system that a folder lies on; of several at one place the last one."""
    found, longest = ("unknown", ""), -1
    for line in mounts.read_text().splitlines():
        _, place, kind, options, *_ = line.split(" ")
        point = Path(_ESCAPED.sub(lambda code: chr(int(code[1], 8)), place))
        if folder.resolve().is_relative_to(point) and len(point.parts) >= longest:
            found, longest = (kind, options), len(point.parts)
    return found


def _refused(folder: Path) -> str:
    """Why files cannot be locked in a folder; empty if they can."""
    try:
        with tempfile.TemporaryDirectory(prefix=".nvsf-locks-", dir=folder) as place:
            path = Path(place) / "one.lock"
            with path.open("a+") as first, path.open("a+") as second:
                fcntl.flock(first, fcntl.LOCK_EX | fcntl.LOCK_NB)
                try:
                    fcntl.flock(second, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    return ""
    except OSError as error:
        return f"a file cannot be locked ({error.strerror or error})"
    return "a lock that is held is given to another, too"
