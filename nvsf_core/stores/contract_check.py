"""Check a stage's output against the data contract before it is published; no data is read."""

from collections.abc import Iterator
from pathlib import Path

from nvsf_core.stores.arrays import array_layouts
from nvsf_core.stores.schemas import CONTRACT, FileSpec, column_faults, path_patterns, violations
from nvsf_core.stores.tables import column_kinds


def contract_faults(stage: str, location: str, folder: Path) -> list[str]:
    """Violations of the data contract by the files of a stage's output, one sentence each.

    Absent files are allowed: they depend on the drive's sensors and on the views. `location` is the output's
    future path below the scene's folder, for example `field/lean/0`; `folder` is its present one.

    Raises:
        StoreError: A file cannot be read.
    """
    depth = len(location.split("/"))
    return [
        f"{path.relative_to(folder)}: {fault}"
        for spec in CONTRACT
        if spec.stage == stage
        for path in sorted(folder.glob("/".join(path_patterns(spec)[depth:])))
        for fault in _faults(spec, path)
    ]


def _faults(spec: FileSpec, path: Path) -> Iterator[str]:
    if spec.kind == "zarr":
        arrays = array_layouts(path)
        # A drive without the sensor leaves the group empty.
        yield from violations(spec, arrays) if arrays else ()
        return
    columns = column_kinds(path)
    yield from (f"column {field.name}: expected {field.dtype}, found nothing" for field in spec.fields
                if field.name not in columns and not field.optional)  # fmt: skip
    yield from column_faults(spec, columns)
