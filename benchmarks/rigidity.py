"""Whether anything moves that no rigid motion explains: returns of moving things against what stands.

Run ``python -m benchmarks.rigidity [--scene kitti0005_van_cyclist]`` after the scene's stage `evidence`; it
prints a table and writes benchmarks/results/rigidity.json. Training scans only.

Each scan's returns of a moving object are laid, by its rigid path, over those of the 4 scans nearest in time
(as many as the renderer uses) and compared with the plane through the 8 nearest of them. The same is done
with returns of what stands, at the same distances from the sensor and heights above the ground, and with the
moving object's returns as if it had stood still.
"""

import argparse
import itertools
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.machine import commit, machine
from nvsf_core.evidence.find_moving import STANDING_M
from nvsf_core.evidence.ground import build_ground
from nvsf_core.evidence.objects import NEAREST_SCANS, ObjectEvidence
from nvsf_core.kitti360.catalogue import home_from_environment
from nvsf_core.stages.evidence import read_evidence, read_sweeps, training_returns
from nvsf_core.stores.scene_store import SceneStore

RESULTS = Path(__file__).resolve().parent / "results" / "rigidity.json"
VEHICLE_M = 2.5
"""What is at least as long is a vehicle; smaller things are people, on foot or on wheels."""
FEWEST_RETURNS = 1000
"""Of an object that is told by itself: below it, its own surface is hardly known."""
FAR_OFF_M = 0.1
"""A return farther off its surface than this would be seen to be wrong."""
_NEIGHBOURS = 8
_UNSEEN_M = 0.5
"""Without a return so near in the other scans a place was not seen by them: no surface to compare with."""
_HIGHEST_M = 2.5
_STANDING_A_SCAN = 4000
_NEAR_M, _FAR_M = 4.0, 40.0


def surface_distance_m(point_m: np.ndarray, seen_m: np.ndarray) -> np.ndarray:
    """Distance (n,) of points (n, 3) to the plane through the 8 nearest of others (m, 3), m >= 8.

    NaN where the nearest lies more than 0.5 m off.
    """
    near_m, near = cKDTree(seen_m).query(point_m, _NEIGHBOURS)
    around = seen_m[near]
    centre = around.mean(axis=1)
    apart = around - centre[:, None]
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))
    distance = np.abs(np.einsum("ni,ni->n", point_m - centre, axes[:, :, 0]))
    return np.where(near_m[:, 0] <= _UNSEEN_M, distance, np.nan)


def object_distances_m(one: ObjectEvidence, *, is_moved: bool) -> tuple[np.ndarray, np.ndarray]:
    """Of an object's returns: distance to its surface as its nearest other scans show it, and range.

    `is_moved`: by its rigid path; else as if it had stood still.
    """
    rays = one.rays
    point_o = rays.origin_m + rays.direction * rays.range_m[:, None]
    if not is_moved:
        scan_pose = one.path.matrix_at(one.path.time_s)
        pose = scan_pose[np.searchsorted(one.path.scan, rays.scan)]
        point_o = np.einsum("nij,nj->ni", pose[:, :3, :3], point_o) + pose[:, :3, 3]
    distances, ranges = [], []
    for scan, time_s in zip(one.path.scan, one.path.time_s, strict=True):
        mine = rays.is_hit & (rays.scan == scan)
        others = rays.is_hit & np.isin(rays.scan, one.scans_near(float(time_s), leave_out=int(scan)))
        if mine.any() and others.sum() >= _NEIGHBOURS:
            distances.append(surface_distance_m(point_o[mine], point_o[others]))
            ranges.append(rays.range_m[mine])
    return np.concatenate([[], *distances]), np.concatenate([[], *ranges])


def standing_distances_m(store: SceneStore, objects: tuple[ObjectEvidence, ...]) -> np.ndarray:
    """(n, 2) of returns of what stands: distance to its surface, and range.

    As high above the ground as people and vehicles are; what moves is left out, and what is near its path.
    """
    sweeps = read_sweeps(store)
    assert sweeps is not None
    returns = training_returns(sweeps)
    range_m = np.linalg.norm(returns.recorded_m, axis=1)
    height_m = build_ground(returns.point_m[~returns.is_own_vehicle]).above(returns.point_m)
    used = ~returns.is_own_vehicle & (height_m > STANDING_M) & (height_m < _HIGHEST_M)
    used &= (range_m > _NEAR_M) & (range_m < _FAR_M)
    scan = returns.scan_of(np.arange(len(range_m)))
    for one in objects:
        local = one.path.to_object(returns.point_m.astype(np.float64), returns.time_s)
        used &= ~np.all((local > one.path.low_m - 0.3) & (local < one.path.high_m + 0.3), axis=1)
    random, found = np.random.default_rng(0), []
    for k in range(returns.scan_count):
        near = np.argsort(np.abs(np.arange(returns.scan_count) - k), kind="stable")[1 : NEAREST_SCANS + 1]
        mine = np.flatnonzero(used & (scan == k))
        mine = random.choice(mine, min(len(mine), _STANDING_A_SCAN), replace=False)
        seen = returns.point_m[used & np.isin(scan, near)].astype(np.float64)
        if len(seen) >= _NEIGHBOURS and len(mine):
            found.append(np.stack([surface_distance_m(returns.point_m[mine], seen), range_m[mine]], axis=1))
    return np.concatenate([np.zeros((0, 2)), *found])


def figures(distance_m: np.ndarray) -> dict[str, float]:
    """Median, 90th percentile, share farther off than 10 cm, share of places that others never saw."""
    known = distance_m[np.isfinite(distance_m)]
    return {
        "returns": len(distance_m), "median_m": float(np.median(known)),
        "p90_m": float(np.quantile(known, 0.9)), "far_off_share": float((known > FAR_OFF_M).mean()),
        "unseen_share": 1.0 - len(known) / len(distance_m),
    }  # fmt: skip


def like(standing: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    """Distances (n,) of standing returns at the ranges of some others, as many at each as those are."""
    random, low = np.random.default_rng(0), np.quantile(range_m, [0.0, 0.25, 0.5, 0.75, 1.0])
    parts = [standing[(standing[:, 1] >= a) & (standing[:, 1] <= b), 0] for a, b in itertools.pairwise(low)]
    count = min((len(part) for part in parts if len(part)), default=0)
    return np.concatenate([random.choice(part, count, replace=False) for part in parts if len(part)])


def measure(store: SceneStore) -> dict[str, Any]:
    """All figures of a scene whose evidence lies published."""
    evidence = read_evidence(store)
    if evidence is None or evidence.dynamic is None:
        raise SystemExit(f"scene {store.scene}: nothing was seen to move")
    objects = evidence.dynamic.objects
    standing = standing_distances_m(store, objects)
    total = int(evidence.prior.is_hit.sum())
    rows, kinds = [], dict[str, list[tuple[np.ndarray, ...]]]()
    for number, one in enumerate(objects):
        moved, range_m = object_distances_m(one, is_moved=True)
        still, _ = object_distances_m(one, is_moved=False)
        size_m = one.path.high_m - one.path.low_m
        kind = "vehicle" if size_m[:2].max() >= VEHICLE_M else "person"
        if len(moved):
            kinds.setdefault(kind, []).append((moved, still, range_m))
        if len(moved) >= FEWEST_RETURNS:
            rows.append(_row(f"object {number}, {kind}", (moved, still, range_m), standing) | {
                "size_m": [round(float(side), 2) for side in size_m], "scans": len(one.path.scan),
            })  # fmt: skip
    for kind, parts in kinds.items():
        columns = tuple(np.concatenate(column) for column in zip(*parts, strict=True))
        rows.append(_row(f"all of kind {kind}", columns, standing) | {"objects": len(parts)})
    for row in rows:
        excess = row["rigid"]["far_off_share"] - row["standing"]["far_off_share"]
        row["excess_share_of_all_returns"] = max(0.0, excess) * row["rigid"]["returns"] / total
    return {"scene": store.scene, "returns": total, "standing": figures(standing[:, 0]), "rows": rows}


def _row(name: str, columns: tuple[np.ndarray, ...], standing: np.ndarray) -> dict[str, Any]:
    moved, still, range_m = columns
    return {
        "name": name, "range_m": float(np.median(range_m)), "rigid": figures(moved),
        "if_it_stood": figures(still), "standing": figures(like(standing, range_m)),
    }  # fmt: skip


def table(found: dict[str, Any]) -> str:
    """Markdown of what `measure` gave."""
    lines = [
        "| what | returns | range m | rigid: median / p90 m | > 10 cm | standing, same range: median / p90 m "
        "| > 10 cm | as if it stood: median m | excess over 10 cm, of all returns |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in found["rows"]:
        rigid, stands = row["rigid"], row["standing"]
        lines.append(
            f"| {row['name']} | {rigid['returns']} | {row['range_m']:.1f} "
            f"| {rigid['median_m']:.3f} / {rigid['p90_m']:.3f} | {rigid['far_off_share']:.1%} "
            f"| {stands['median_m']:.3f} / {stands['p90_m']:.3f} | {stands['far_off_share']:.1%} "
            f"| {row['if_it_stood']['median_m']:.3f} | {row['excess_share_of_all_returns']:.3%} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default="kitti0005_van_cyclist")
    arguments = parser.parse_args()
    found = measure(SceneStore(home=home_from_environment(os.environ), scene=arguments.scene))
    facts = {"machine": machine(), "commit": commit()} | found
    RESULTS.write_text(json.dumps(facts, indent=1) + "\n")
    print(table(found))


if __name__ == "__main__":
    main()
