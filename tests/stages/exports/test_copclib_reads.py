"""The format `laz` as copc-lib reads it, where it is installed: a decoder and a header reader of its own."""

from pathlib import Path

import numpy as np
import pytest

from nvsf_core.clouds.laz import write_laz
from tests.stages.exports import small_data_set as small

_FURTHER = np.dtype([("ring", "<u2"), ("time", "<f4"), ("support", "u1")])


def test_laz_is_read_without_its_writers_libraries(tmp_path: Path) -> None:
    reading = pytest.importorskip("copclib", reason="`pip install copclib` is not done")
    for needed in ("laspy", "lazrs"):
        pytest.importorskip(needed, reason="the extra `exports` is not installed")
    scan = small.scan(0)
    write_laz(tmp_path / "a.laz", scan.rows, scan.ring, scan.offset_s, scan.support)
    # It refuses a header that is not as LAS 1.4 says.
    cloud = reading.LazReader(str(tmp_path / "a.laz")).GetPoints()
    points = [cloud[number] for number in range(len(cloud))]
    assert len(points) == len(scan.rows)
    np.testing.assert_allclose([(p.x, p.y, p.z) for p in points], scan.rows[:, :3], atol=6e-5)
    np.testing.assert_allclose([p.intensity / 65535.0 for p in points], scan.rows[:, 3], atol=1e-5)
    assert {(p.return_number, p.number_of_returns) for p in points} == {(1, 1)}
    # It gives further dimensions as the bytes that they are.
    further = np.frombuffer(bytes(byte for p in points for byte in p.extra_bytes), _FURTHER)
    np.testing.assert_array_equal(further["ring"], scan.ring)
    np.testing.assert_array_equal(further["time"], scan.offset_s)
    np.testing.assert_array_equal(further["support"], scan.support)
