"""The table of stability names functions that there are."""

import re
from functools import cached_property
from importlib import import_module

import pytest

from benchmarks.numerics.stability import THEMES
from nvsf_core import __name__ as core


@pytest.mark.parametrize("theme", [theme for theme in THEMES if theme != "shifted_drives"])
def test_every_case_names_a_function_of_the_core(theme):
    cases = import_module(f"benchmarks.numerics.cases.{theme}").CASES
    assert [case.function for case in cases if not _is_there(case.function)] == []


def test_the_document_names_functions_of_the_core(repo):
    named = set(
        re.findall(r"^\| `([^`]+)`", (repo / "docs/numerical_stability.md").read_text(), re.MULTILINE)
    )
    assert [name for name in named if not name.startswith("stages.") and not _is_there(name)] == []


def _is_there(name: str) -> bool:
    """Whether a dotted name below the core is a function, a method or a property."""
    parts = name.split(".")
    for count in range(len(parts) - 1, 0, -1):
        try:
            found: object = import_module(".".join([core, *parts[:count]]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            found = getattr(found, part, None)
        return callable(found) or isinstance(found, property | cached_property)
    return False
