"""Table schemas for the UI: the columns of a stage's main table, or the arrays of its main Zarr group."""

import dagster as dg

from nvsf_core.stores.schemas import CONTRACT, Entry, FileSpec


def schema_metadata(stage: str) -> dict[str, dg.TableSchema]:
    """Metadata with the schema of what a stage publishes, by the data contract; empty if it says nothing."""
    specs = sorted(
        (spec for spec in CONTRACT if spec.stage == stage), key=lambda spec: spec.kind != "parquet"
    )
    found: dict[str, dg.TableSchema] = {}
    for spec in specs:
        # The UI shows one schema under this name; the others are listed beside it.
        name = "dagster/column_schema" if not found else f"schema of {spec.path}"
        found[name] = _schema(spec)
    return found


def _schema(spec: FileSpec) -> dg.TableSchema:
    return dg.TableSchema(columns=[_column(entry) for entry in spec.fields])


def _column(entry: Entry) -> dg.TableColumn:
    shape = f" ({', '.join(map(str, entry.shape))})" if entry.shape else ""
    unit = f" [{entry.unit}]" if entry.unit not in ("", "1") else ""
    return dg.TableColumn(
        name=entry.name,
        type=f"{entry.dtype}{shape}",
        description=f"{entry.meaning}{unit}",
        constraints=dg.TableColumnConstraints(nullable=entry.optional),
    )
