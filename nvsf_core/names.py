"""Which names may become part of a path (scenes, views, recipes, sequences, labels), and how any is shown."""

import re
import unicodedata

LONGEST_NAME = 100
"""Characters. A file system takes 255 bytes; a folder that is being written adds 40 to its name."""

RESERVED_SCENES = ("benchmark_report", "dagster", "drives")
"""Other folders of a home: a scene of such a name would share its folder with them."""
RESERVED_VIEWS = ("train", "val", "test")
"""Splits of recorded frames, which metrics list in the same column as views."""

_PLAIN = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9_@-]|\.(?!\.))*")
_STORED = (".json", ".parquet", ".png", ".safetensors", ".zarr")
"""Endings of output files: a folder of such a name could take a file's place."""


def name_fault(name: object, reserved: tuple[str, ...] = ()) -> str | None:
    """Why a name cannot be a folder's; None if it can.

    A plain name begins with a letter or digit, goes on with letters, digits and `_ . @ -`, has no two dots
    in a row (Dagster's partition keys may not have three), and at most `LONGEST_NAME` characters.
    """
    if not isinstance(name, str):
        return f"expected a name as text, found {name!r}"
    if len(name) > LONGEST_NAME:
        return f"a name is a folder: expected at most {LONGEST_NAME} characters, found {len(name)}"
    if not _PLAIN.fullmatch(name):
        return (
            f"a name is a folder and a partition key: expected a letter or digit, then only letters, digits, "
            f"`_.@-` and no two dots in a row, found {name!r}"
        )
    if name.endswith(_STORED):
        return f"{name!r} ends like a file of the store ({', '.join(_STORED)}); choose another name"
    if name in reserved:
        return f"{name!r} is reserved ({', '.join(reserved)}); choose another name"
    return None


def printable(line: object) -> str:
    r"""One line, with what is not printable escaped as Python does it: ESC as `\x1b`, a new line as `\n`.

    A terminal obeys such characters, and names and words of drives may be made to do harm. Halves of
    surrogate pairs, as names that are no UTF-8 have them, no stream can write.
    """
    return "".join(
        one if one.isprintable() or unicodedata.category(one) == "Zs" else ascii(one)[1:-1]
        for one in str(line)
    )
