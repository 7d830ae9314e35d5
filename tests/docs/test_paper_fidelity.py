"""docs/paper_fidelity.md says of every switch what the paper, its authors' code and we do."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from benchmarks.paper import gradient_mask
from benchmarks.paper.parameters import counts, table
from nvsf_core.recipe.paper import (
    EncoderSpec,
    GradientLossSpec,
    PaperLosses,
    PaperOptimiser,
    PaperRecipe,
    PaperSampling,
    ReferenceQuirks,
    RefinementSpec,
)

LINES = (Path(__file__).parents[2] / "docs" / "paper_fidelity.md").read_text().splitlines()
PARTS = {
    "slips": ReferenceQuirks,
    "gradient": GradientLossSpec,
    "sampling": PaperSampling,
    "optimiser": PaperOptimiser,
    "refinement": RefinementSpec,
    "encoder": EncoderSpec,
    "losses": PaperLosses,
}


def first_cells() -> str:
    """What the tables' rows are about."""
    return "\n".join(line.split("|")[1] for line in LINES if line.startswith("| "))


def fields(kind: type) -> list[str]:
    return [field.name for field in dataclasses.fields(kind)]


@pytest.mark.parametrize("part", [part for part in PARTS if part != "losses"])
def test_every_switch_has_a_row(part):
    missing = [name for name in fields(PARTS[part]) if f"`{part}.{name}`" not in "\n".join(LINES)]
    assert missing == []
    assert [name for name in fields(PARTS[part]) if f"{part}.{name}" in first_cells()]


def test_every_loss_and_every_slip_has_a_row_of_its_own():
    cells = first_cells()
    assert [name for name in fields(PaperLosses) if f"`{name}`" not in cells] == []
    assert [name for name in fields(ReferenceQuirks) if f"`slips.{name}`" not in cells] == []


def test_every_part_of_the_recipe_is_named():
    own = set(fields(PaperRecipe)) - {"name", "losses", "optimiser"}
    text = "\n".join(LINES)
    assert [name for name in sorted(own) if not re.search(rf"`{name}[`. ]", text)] == []


def test_every_switch_that_is_named_exists():
    named = re.findall(r"`(\w+)\.(\w+)[` ]", "\n".join(LINES))
    wrong = [(part, name) for part, name in named if part in PARTS and name not in fields(PARTS[part])]
    assert wrong == []


def test_every_encoding_strategy_has_a_row():
    for strategy in ("separate", "same", "separate_fused"):
        assert f"`{strategy}`" in "\n".join(LINES) or f'"{strategy}"' in first_cells()


def test_every_row_is_as_wide_as_its_head():
    heads = [k for k, line in enumerate(LINES) if re.fullmatch(r"\|[-: |]+\|", line)]
    assert len(heads) >= 6
    for head in heads:
        row = head
        while row < len(LINES) and LINES[row].startswith("|"):
            assert LINES[row].replace("\\|", "").count("|") == LINES[head].count("|"), LINES[row]
            row += 1


def test_the_parameter_table_is_the_codes_own():
    begin, end = LINES.index("<!-- parameters -->"), LINES.index("<!-- end of parameters -->")
    assert LINES[begin + 1 : end] == table().splitlines()


def test_the_masks_coverage_is_what_was_measured():
    begin, end = LINES.index("<!-- gradient_mask -->"), LINES.index("<!-- end of gradient_mask -->")
    rows = json.loads(gradient_mask.RESULTS.read_text())
    assert LINES[begin + 1 : end] == gradient_mask.table(rows).splitlines()


def test_the_paper_has_the_authors_parameters_without_dead_weights_and_padding():
    found = counts(PaperRecipe(name="paper"))
    assert sum(found.values()) == 131_658_017 - 31_541_248 - 4_480 == 100_112_289
    sensors = [sum(n for part, n in found.items() if part.startswith(f"encoders.{k}.")) for k in (0, 1)]
    assert sensors == [31_541_248] * 2
    assert found["flow.grid"] + found["flow.network"] == 30_459_392


def test_the_document_is_short():
    assert len(LINES) < 200
