"""The one rule for every name that becomes part of a path: scenes, views, recipes, sequences, labels."""

import re

LONGEST_NAME = 100
"""Characters. A file system takes 255 bytes; a folder that is being written adds 40 to its name."""

RESERVED_SCENES = ("benchmark_report", "dagster", "drives")
"""What else lies in a home: a scene of such a name would lose its outputs to it."""
RESERVED_VIEWS = ("train", "val", "test")
"""Splits of recorded frames, in the column where metrics name a view."""

_PLAIN = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9_@-]|\.(?!\.))*")
_STORED = (".json", ".parquet", ".png", ".safetensors", ".zarr")
"""What outputs call their files: a folder of such a name would take a file's place."""


def name_fault(name: object, reserved: tuple[str, ...] = ()) -> str | None:
    """What keeps a name from being used as one folder's; None where nothing does.

    A plain name begins with a letter or digit, goes on with letters, digits and `_ . @ -`, has no two dots
    in a row (Dagster's partition keys may not have three), and at most `LONGEST_NAME` characters.

    Args:
        name: Anything.
        reserved: Names that stand for something else where this one will be used.
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
