"""What `benchmarks.kernels.voxel_walk` measured, as a section of docs/results.md."""

import json
from pathlib import Path

WALK_RESULTS = Path("benchmarks", "results", "voxel_walk.json")
"""In a checkout."""


def walk_table(root: Path) -> str:
    """The section of docs/results.md in a checkout; empty where nothing was measured."""
    path = root / WALK_RESULTS
    if not path.is_file():
        return ""
    facts = json.loads(path.read_text())
    lines = [
        "## The walk through the voxels\n",
        f"`python -m benchmarks.kernels.voxel_walk`: million rays a second. *build*: all training returns to "
        f"surfels, see-throughs counted; *list*: the surfaces a ray may end on; *answer*: the range that "
        f"`reproject` gives; its error is that of the held-out returns. Machine: {facts['machine']}. "
        f"Commit {facts['commit']}. Target: a walk of at least 1.\n",
        "| scene | surfaces | voxel m | voxels | build | list | answer | median error m |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in facts["rows"]:
        rates = " | ".join(f"{row[f'{name}_rays_s'] / 1e6:.2f}" for name in ("build", "list", "answer"))
        lines.append(
            f"| `{row['scene']}` | {row['surfaces']} | {row['voxel_m']:.2f} | {row['voxels']:,} | {rates} "
            f"| {row['median_error_m']:.4f} |"
        )
    return "\n".join(lines) + "\n"
