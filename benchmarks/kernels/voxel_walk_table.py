"""The results of `benchmarks.kernels.voxel_walk` as a section of docs/results.md."""

import json
from pathlib import Path

from benchmarks.common.documents import markdown_table

WALK_RESULTS = Path("benchmarks", "results", "voxel_walk.json")
"""In a checkout."""


def walk_table(root: Path) -> str:
    """The section of docs/results.md in a checkout; empty where nothing was measured."""
    path = root / WALK_RESULTS
    if not path.is_file():
        return ""
    facts = json.loads(path.read_text())
    about = (
        f"## The walk through the voxels\n\n"
        f"`python -m benchmarks.kernels.voxel_walk`: million rays a second. *build*: all training returns to "
        f"surfels of both kinds, see-throughs counted; *list*: the surfaces a ray may end on; *answer*: the "
        f"range that `reproject` gives; its error is that of the held-out returns. "
        f"Machine: {facts['machine']}. Commit {facts['commit']}. Target: a walk of at least 1.\n\n"
    )
    rates = ("build", "list", "answer")
    rows = [
        [
            f"`{row['scene']}`", row["surfaces"], f"{row['voxel_m']:.2f}", f"{row['voxels']:,}",
            *(f"{row[f'{name}_rays_s'] / 1e6:.2f}" for name in rates), f"{row['median_error_m']:.4f}",
        ]
        for row in facts["rows"]
    ]  # fmt: skip
    head = ["scene", "surfaces", "voxel m", "voxels", *rates, "median error m"]
    return about + markdown_table(head, rows)
