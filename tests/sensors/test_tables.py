import numpy as np
import pytest

from nvsf_core.errors import DataError
from nvsf_core.sensors.tables import HDL_64E, SENSOR_TABLES, sensor_table


@pytest.mark.parametrize("name", sorted(SENSOR_TABLES))
def test_every_table_is_whole_and_ordered_from_the_top(name):
    table = sensor_table(name)
    columns = (
        table.elevation_rad, table.vertical_offset_m, table.horizontal_offset_m, table.phase_steps,
        table.firing_shift_steps,
    )  # fmt: skip
    assert {column.shape for column in columns} == {(table.laser_count,)}
    assert all(np.isfinite(column).all() for column in columns)
    assert (np.diff(table.elevation_rad) < 0).all()
    assert all(not column.flags.writeable for column in columns)


def test_hdl_64e_spans_what_its_maker_says():
    assert HDL_64E.laser_count == 64
    assert np.rad2deg(HDL_64E.elevation_rad[[0, -1]]) == pytest.approx([1.9364, -24.9995])


def test_an_unknown_sensor_is_refused_with_the_known_ones():
    with pytest.raises(DataError, match="HDL-64E"):
        sensor_table("HDL-65")
