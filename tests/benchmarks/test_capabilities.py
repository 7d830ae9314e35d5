"""The table of capabilities counts code that there is."""

from benchmarks.tables.capabilities import CAPABILITIES, lines_of


def test_every_capability_has_its_lines():
    assert [one.name for one in CAPABILITIES if lines_of(one) < 10] == []


def test_a_function_counts_alone():
    whole, part = (
        next(lines_of(one) for one in CAPABILITIES if one.name == name)
        for name in ("the field of rays", "rays that meet nothing are copied")
    )
    assert 30 < part < whole
