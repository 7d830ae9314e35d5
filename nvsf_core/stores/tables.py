"""Tables of named columns in Parquet."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from nvsf_core.errors import StoreError

Column = Sequence[Any]


def write_table(path: Path, columns: Mapping[str, Column]) -> None:
    """Write equally long columns (numbers, strings, lists of numbers; None = unknown)."""
    pq.write_table(pa.table({name: pa.array(list(column)) for name, column in columns.items()}), path)


def read_table(path: Path) -> dict[str, list[Any]]:
    """Read a table as column name to list.

    Raises:
        StoreError: There is no such file.
    """
    if not path.is_file():
        raise StoreError(f"no table at {path}; run the stage that makes it")
    columns: dict[str, list[Any]] = pq.read_table(path).to_pydict()
    return columns


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read a table row by row, each row a dict."""
    columns = read_table(path)
    names = list(columns)
    return [dict(zip(names, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> None:
    """Write rows with the given column names, in that order."""
    write_table(path, {name: [row[name] for row in rows] for name in names})
