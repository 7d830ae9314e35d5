"""JSON documents on disk: read whole or refused, replaced whole."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nvsf_core.errors import StoreError
from nvsf_core.stores.contents import Contents, foreign

MOST_BYTES = 64 << 20
"""Larger than any document that a stage writes; what is larger is no document."""


def read_document(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        StoreError: The file is absent, no regular file, too large, or holds no JSON object.
    """
    if not path.is_file():
        raise StoreError(f"no document at {path}; run the stage that makes it")
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise ValueError(f"{size:,} bytes")
        found = json.loads(path.read_text(encoding="utf-8"))
    # Text that nests some thousand brackets deep ends in a RecursionError.
    except (OSError, ValueError, RecursionError) as error:
        raise foreign(
            path, f"expected a JSON object of at most {MOST_BYTES >> 20} MiB, found {error!s:.200}"
        ) from error
    if not isinstance(found, dict):
        raise foreign(path, f"expected a JSON object, found a {type(found).__name__}")
    return Contents(path, found)


def write_document(path: Path, values: Mapping[str, Any]) -> None:
    """Write a JSON object; the file at `path` is the old one or the new one."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(json.dumps(dict(values), indent=1))
    temporary.replace(path)
