"""Coverage of the double-gradient mask by distance, beside the single-gradient one, on recorded panos.

Run ``python -m benchmarks.paper.gradient_mask PANO.zarr [PANO.zarr ...]`` with outputs of the stage `pano`,
such as ``.nvsf/k360_street/pano/pano.zarr``. Writes ``benchmarks/results/gradient_mask.json`` and the table
of ``docs/paper_fidelity.md``; without any it writes the table anew from the JSON.
"""

import argparse
from itertools import pairwise
from pathlib import Path
from typing import Literal

import torch

from benchmarks.common import documents
from nvsf_core.losses.gradient import BAND_EDGES_M, gradient_mask, mask_coverage
from nvsf_core.stores.arrays import read_arrays

RESULTS = documents.RESULTS_DIR / "gradient_mask.json"
DOCUMENT = documents.DOCS / "paper_fidelity.md"
MASKS: tuple[tuple[Literal["double", "single"], float], ...] = (
    ("double", 0.05),
    ("single", 0.05),
    ("single", 0.01),
)
"""The paper's, the same threshold on the gradient itself, and the earlier codes' threshold."""


def coverage_rows(pano: Path, grid: str) -> list[dict[str, object]]:
    """One row a mask, axis and band of all scans of a pano store."""
    ranges = torch.from_numpy(read_arrays(pano, f"{grid}_range_m")[f"{grid}_range_m"])
    rows: list[dict[str, object]] = []
    for kind, threshold_m in MASKS:
        for axis, mask in zip("xy", gradient_mask(ranges, kind, threshold_m), strict=True):
            bands = mask_coverage(mask, ranges)
            for (low_m, high_m), (returns, inside) in zip(pairwise(BAND_EDGES_M), bands, strict=True):
                rows.append(
                    {
                        "scene": pano.resolve().parents[1].name, "grid": grid, "scans": len(ranges),
                        "mask": kind, "threshold_m": threshold_m, "axis": axis, "from_m": low_m,
                        "to_m": high_m, "returns": returns, "inside": inside,
                        "coverage": inside / returns if returns else None,
                    }
                )  # fmt: skip
    return rows


def table(rows: list[dict[str, object]]) -> str:
    """The rows as Markdown, a column a band, in percent of the returns."""
    bands = [f"{low:.0f}-{high:.0f} m" for low, high in pairwise(BAND_EDGES_M)]
    lines = []
    for first in range(0, len(rows), len(bands)):
        row = rows[first]
        cells = [_percent(cell["coverage"]) for cell in rows[first : first + len(bands)]]
        about = [row["scene"], row["grid"], row["axis"], row["mask"], f"{row['threshold_m']} m"]
        lines.append([*about, *cells])
    head = ["scene", "grid", "along", "mask", "threshold", *bands]
    return documents.markdown_table(head, lines, "|---|---|---|---|---|" + "---:|" * len(bands))


def main() -> None:
    """Measure, write, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pano", nargs="*", type=Path, help="pano.zarr of a scene")
    parser.add_argument("--grid", choices=("linear", "beam"), default="linear", help="linear: the paper's")
    arguments = parser.parse_args()
    rows = [row for pano in arguments.pano for row in coverage_rows(pano, arguments.grid)]
    if rows:
        documents.write_json(RESULTS, rows)
    text = table(documents.read_rows(RESULTS))
    documents.write_between(DOCUMENT, "gradient_mask", text)
    print(text, end="")


def _percent(share: object) -> str:
    return f"{100 * share:.1f} %" if isinstance(share, float) else "no return"


if __name__ == "__main__":
    main()
