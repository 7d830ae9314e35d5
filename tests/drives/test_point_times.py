"""Times of points by their unit: whole nanoseconds, or microseconds where nanoseconds cannot be."""

import numpy as np
import pytest

from nvsf_core.drives.point_times import after_frame
from nvsf_core.errors import DataError

CLOCK_S = 1_700_000_000


def _after(ticks: np.ndarray, stamp_s: float | None = None) -> np.ndarray:
    return after_frame("a.pcd: t", ticks, np.ones(len(ticks), bool), stamp_s)


# Floating-point numbers are seconds, unless no clock counts as many.
@pytest.mark.parametrize(("begin_s", "kind"), [(0, np.int64), (CLOCK_S, np.int64), (CLOCK_S, np.float64)])
@pytest.mark.parametrize("tick_s", [1e-9, 1e-6])
def test_a_sweep_of_whole_ticks_lasts_a_tenth_of_a_second(begin_s: int, tick_s: float, kind: type) -> None:
    ticks = (np.linspace(0.0, 0.1, 30_000) / tick_s).astype(np.int64) + begin_s * round(1.0 / tick_s)
    found = _after(ticks.astype(kind), float(begin_s) if begin_s else None)
    assert np.allclose(found, np.linspace(0.0, 0.1, 30_000), rtol=0.0, atol=1e-5)


def test_a_part_of_a_sweep_in_nanoseconds_is_not_taken_for_microseconds() -> None:
    ticks = np.linspace(0.0, 0.01 * 1e9, 3000).astype(np.uint32)
    assert _after(ticks).max() == pytest.approx(0.01)


@pytest.mark.parametrize("ticks", [np.arange(0, 100), np.arange(0, 100_000, 200), np.arange(30_000) // 300])
def test_whole_numbers_that_make_no_scan_are_refused(ticks: np.ndarray) -> None:
    with pytest.raises(DataError, match=r"a\.pcd: t: expected times of one scan.*write these, or floating"):
        _after(ticks)


def test_points_that_have_one_time_are_of_an_instant() -> None:
    assert not _after(np.zeros(1000, np.uint32)).any()
