"""Tables of named columns in Parquet, each page with a checksum."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from nvsf_core.errors import StoreError
from nvsf_core.stores.documents import Contents, foreign, unreadable
from nvsf_core.stores.schemas import column_faults, spec_at

Column = Sequence[Any]

_SHORT = {"int64": "i8", "double": "f8", "bool": "bool", "string": "string", "null": "null"}
"""Arrow's name of a type to the contract's."""


def write_table(path: Path, columns: Mapping[str, Column]) -> None:
    """Write equally long columns (numbers, strings, lists of numbers; None = unknown)."""
    table = pa.table({name: pa.array(list(column)) for name, column in columns.items()})
    pq.write_table(table, path, write_page_checksum=True)


def read_table(path: Path) -> dict[str, list[Any]]:
    """Read a table as column name to list.

    Raises:
        StoreError: The file is absent or damaged, or its columns break the data contract.
    """
    if not path.is_file():
        raise StoreError(f"no table at {path}; run the stage that makes it")
    try:
        # Not `pq.read_table`: it also opens folders, and adds columns by their names.
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            table = file.read()
            columns: Contents[list[Any]] = Contents(path, table.to_pydict())
    except Exception as error:  # Arrow, its decoders and the disk raise many kinds of errors
        raise unreadable(
            path, error, f"expected a Parquet table, found it damaged ({error!r:.300})"
        ) from error
    spec = spec_at(path)
    faults = [] if spec is None else column_faults(spec, {f.name: _short(f.type) for f in table.schema})
    if faults:
        raise foreign(path, "; ".join(faults[:3]))
    return columns


def column_kinds(path: Path) -> dict[str, str]:
    """Name to type of a table's columns, by the contract's names of types; no row is read.

    Raises:
        StoreError: The table is absent or damaged.
    """
    try:
        return {field.name: _short(field.type) for field in pq.read_schema(path)}
    except Exception as error:
        raise unreadable(
            path, error, f"expected a Parquet table, found it damaged ({error!r:.300})"
        ) from error


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read a table row by row, each row a dict.

    Raises:
        StoreError: See `read_table`.
    """
    columns = read_table(path)
    names = list(columns)
    return [Contents(path, zip(names, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> None:
    """Write rows with the given column names, in that order."""
    write_table(path, {name: [row[name] for row in rows] for name in names})


def _short(kind: pa.DataType) -> str:
    if pa.types.is_list(kind):
        return f"list<{_short(kind.value_type)}>"
    return _SHORT.get(str(kind), str(kind))
