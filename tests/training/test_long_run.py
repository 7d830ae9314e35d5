"""Five thousand steps of a small field; `make stability` runs a hundred thousand."""

import pytest

from benchmarks.numerics.cases.long_run import long_run


def test_a_long_run_neither_drifts_nor_grows_nor_loses_its_statistics() -> None:
    found = long_run(5_000)
    assert found.is_finite
    assert found.last_loss < found.middle_loss
    assert found.growth < 0.01
    assert max(found.first_moment, found.second_moment) < 1e-5
    assert found.average == pytest.approx(0.0, abs=1e-5)
