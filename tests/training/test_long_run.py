"""Five thousand steps of a small field; `make stability` runs a hundred thousand."""

from benchmarks.numerics.cases.training import long_run


def test_a_long_run_neither_drifts_nor_grows_nor_loses_its_average() -> None:
    assert long_run(5_000).error < 1e-5
