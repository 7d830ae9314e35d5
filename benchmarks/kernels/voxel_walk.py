"""Rays a second of the walk through the evidence's voxels, and how far its ranges are off.

``python -m benchmarks.kernels.voxel_walk`` measures SCENES (default: all whose `evidence` lies under
NVSF_HOME) on an otherwise idle machine, writes benchmarks/results/voxel_walk.json and brings docs/results.md
up to date.
"""

import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.common.documents import ROOT, write_measured
from benchmarks.tables.results_table import WALK_RESULTS, write
from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.evidence.surfels import StaticReturns, Surfels, candidates_of
from nvsf_core.recipe.residual import EvidenceSpec
from nvsf_core.recording.drive import Sweeps
from nvsf_core.rendering.reproject import NEAR_M, reproject_rays
from nvsf_core.stages.inputs import read_evidence, read_sweeps
from nvsf_core.stores.scene_store import SceneStore

_REPEATS = 5


def main() -> int:
    """Measure, write, and print."""
    home = home_from_environment(os.environ)
    stored = sorted(path.parent.name for path in home.glob("[!.]*/evidence"))
    rows = []
    for scene in os.environ.get("SCENES", "").split() or stored:
        rows += measure(SceneStore(home, scene))
    write_measured(ROOT / WALK_RESULTS, {"rows": rows})
    write(home, ROOT)
    print(json.dumps(rows, indent=1))
    return 0


def measure(store: SceneStore) -> list[dict[str, Any]]:
    """One row for surfaces with and one for those without shapes; none of a drive without LiDAR."""
    sweeps, evidence = read_sweeps(store), read_evidence(store)
    if sweeps is None or evidence is None:
        return []
    # What makes the surfels of each kind from all returns of the training scans.
    kinds = {
        "with shapes": (evidence.for_rendering, StaticReturns.shown),
        "without": (evidence.static, StaticReturns.field),
    }
    return [{"scene": store.scene, "surfaces": name, **_row(sweeps, *kind)} for name, kind in kinds.items()]


def _row(sweeps: Sweeps, surfels: Surfels, make: Callable[[StaticReturns, float], Surfels]) -> dict[str, Any]:
    """Training returns prove, held-out returns ask; without any held-out scan the training ones ask."""
    a = sweeps.arrays
    of_training = np.repeat(sweeps.is_training, np.diff(a["offsets"]))
    seen = sweeps.is_of_world()
    proving = seen & of_training
    asking = seen & ~of_training if (seen & ~of_training).any() else proving
    origin_m, direction = a["origin_m"][asking], a["direction"][asking]
    most, far_m = EvidenceSpec().lidar_candidates, float(sweeps.table.max_range_m)
    votes = np.ones(len(origin_m), np.float32)
    coarsest_m = surfels.index.voxel_m * float(surfels.index.edges.max())
    proof = [a[name][proving] for name in ("origin_m", "direction", "range_m", "intensity")]
    build = _seconds(lambda: make(StaticReturns.of(*proof, np.ones(int(proving.sum()), bool)), coarsest_m))
    listing = _seconds(
        lambda: candidates_of(surfels, origin_m, direction, most=most, near_m=NEAR_M, far_m=far_m)
    )
    answering = _seconds(lambda: reproject_rays(surfels, origin_m, direction, votes, most=most, far_m=far_m))
    rendered = reproject_rays(surfels, origin_m, direction, votes, most=most, far_m=far_m)
    off_m = np.abs(rendered.range_m.astype(np.float64) - a["range_m"][asking])
    return {
        "voxel_m": surfels.index.voxel_m,
        "voxels": surfels.index.voxel_count,
        "build_rays_s": int(proving.sum()) / build,
        "list_rays_s": len(origin_m) / listing,
        "answer_rays_s": len(origin_m) / answering,
        "median_error_m": float(np.median(off_m)),
    }


def _seconds(work: Callable[[], object]) -> float:
    """The median of some runs; the first, which loads the compiled kernel, is not among them."""
    work()
    found = []
    for _ in range(_REPEATS):
        started = time.perf_counter()
        work()
        found.append(time.perf_counter() - started)
    return float(np.median(found))


if __name__ == "__main__":
    sys.exit(main())
