"""The table of the LiDAR that recorded a drive, as it is stored with its returns."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from nvsf_core.sensors.tables import SENSOR_TABLES, LaserTable, sensor_table

FOUND_PREFIX = "found"
"""How the name of a table begins that was found from scans."""
ATTRIBUTE = "sensor_table"
_WHOLE = ("firing_shift_steps",)


def table_facts(table: LaserTable) -> dict[str, Any]:
    """A table's values as JSON holds them."""
    values = {one.name: getattr(table, one.name) for one in fields(table)}
    return {name: one.tolist() if isinstance(one, np.ndarray) else one for name, one in values.items()}


def recorded_table(attrs: Mapping[str, Any]) -> LaserTable:
    """The table of the recording sensor, from the attributes of `returns.zarr`.

    A known sensor is stored by its name, one that was found from the scans with all its values.

    Raises:
        DataError: It is no known sensor, and its values are not stored.
    """
    stored = attrs.get(ATTRIBUTE)
    if stored is None or attrs["sensor"] in SENSOR_TABLES:
        return sensor_table(attrs["sensor"])
    values: dict[str, Any] = {
        name: np.array(one, np.int64 if name in _WHOLE else np.float64) if isinstance(one, list) else one
        for name, one in stored.items()
    }
    return LaserTable(**values)
