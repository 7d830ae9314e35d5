"""Tests whether moving objects bend: how far their returns are from a rigid motion, beside static surfaces.

Run ``python -m benchmarks.lean.rigidity [--scene kitti0005_van_cyclist]`` after the scene's stage
`evidence`; it prints a table and writes it into docs/lean_ablation.md and benchmarks/results/rigidity.json.
Training scans only.

Each scan's returns of a moving object are laid, by its rigid path, over those of the 4 scans nearest in time
(as many as the renderer uses) and compared with the plane through the 8 nearest of them. The same is done
with returns of what stands, at the same distances from the sensor and heights above the ground, and with the
moving object's returns as if it had stood still. A limb that swings lies between its other places, and hardly
off them: so the same rays are also rendered from surfels of those 4 scans, as the renderer does, and ranges
compared: what blurs shows there. Objects that have a flow are rendered with it, too.
"""

import argparse
import itertools
import json
import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.common import places
from benchmarks.common.markdown import markdown_table
from benchmarks.common.markers import write_between
from benchmarks.common.stored import write_measured
from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.evidence.moving.detection import ABOVE_GROUND_M
from nvsf_core.evidence.moving.object_evidence import NEAREST_SCANS, OBJECT_VOXEL_M, ObjectEvidence
from nvsf_core.evidence.moving.visibility import build_ground
from nvsf_core.evidence.surfels import Surfels, build_surfels
from nvsf_core.evidence.voxels import PLANE_POINTS
from nvsf_core.recording.drive import training_returns
from nvsf_core.rendering.reproject import reproject_rays
from nvsf_core.stages.inputs import read_evidence, read_sweeps
from nvsf_core.stores.scene_store import SceneStore

RESULTS = places.RESULTS / "rigidity.json"
DOCUMENT = places.DOCS / "lean_ablation.md"
FAR_OFF_M = 0.1
"""A return farther off its surface than this would be seen to be wrong."""
_UNSEEN_M = 0.5
"""Without a return so near in a scan a place was not seen by it: no surface to compare with."""
VEHICLE_M = 2.5
"""What is at least as long is a vehicle; smaller things are people, on foot or on wheels."""
FEWEST_RETURNS = 1000
"""Of an object that has a row of its own: below it, its own surface is hardly known."""
_HIGHEST_M = 2.5
_STANDING_A_SCAN = 4000
_RENDERED_EVERY = 4
"""Of the scans of what stands: surfels of a whole street take longer than those of an object."""
_MOST_SURFACES = 24
_NEAR_M, _FAR_M = 4.0, 40.0
_SHOWN = ("rendered", "flowing", "standing_rendered")


def surface_distance_m(point_m: np.ndarray, seen_m: np.ndarray) -> np.ndarray:
    """Distance (n,) of points (n, 3) to the plane through the 8 nearest of others (m, 3), m >= 8.

    NaN where the nearest lies more than 0.5 m off.
    """
    near_m, near = cKDTree(seen_m).query(point_m, PLANE_POINTS)
    around = seen_m[near]
    centre = around.mean(axis=1)
    apart = around - centre[:, None]
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))
    distance = np.abs(np.einsum("ni,ni->n", point_m - centre, axes[:, :, 0]))
    return np.where(near_m[:, 0] <= _UNSEEN_M, distance, np.nan)


class Moved(NamedTuple):
    """Of one moving object, or of all of a kind; distances and ranges (n,), range errors (m,), all metres."""

    distance_m: np.ndarray
    """To its surface as its nearest other scans show it, by its rigid path."""
    static_m: np.ndarray
    """The same as if it had stood still."""
    range_m: np.ndarray
    error_m: np.ndarray
    """Of the range that these scans' surfels give."""
    error_range_m: np.ndarray
    flowing_m: np.ndarray
    """Range errors with a flow, where the object has one."""


def moved_object(one: ObjectEvidence) -> Moved:
    """What is off at each return of an object, against its 4 nearest other scans."""
    rays, rigid = one.rays, replace(one, flow_m=None)
    moved_m = rays.origin_m + rays.direction * rays.range_m[:, None]
    pose = one.path.matrix_at(one.path.time_s)[np.searchsorted(one.path.scan, rays.scan)]
    static_m = np.einsum("nij,nj->ni", pose[:, :3, :3], moved_m) + pose[:, :3, 3]
    parts = [Moved(*[np.zeros(0)] * 6)]
    for scan, time_s in zip(one.path.scan, one.path.time_s.tolist(), strict=True):
        mine, near = rays.is_hit & (rays.scan == scan), one.scans_near(time_s, leave_out=int(scan))
        others = rays.is_hit & np.isin(rays.scan, near)
        surfels = rigid.surfels_from(near, time_s)
        flowing = surfels if one.flow_m is None else one.surfels_from(near, time_s)
        own = (rays.origin_m[mine], rays.direction[mine], rays.range_m[mine])
        distances = errors = (np.zeros(0),) * 3
        if mine.any() and others.sum() >= PLANE_POINTS:
            laid = (surface_distance_m(at_m[mine], at_m[others]) for at_m in (moved_m, static_m))
            distances = (*laid, own[2])
        if mine.any() and surfels is not None and flowing is not None:
            errors = (_range_error_m(surfels, *own), own[2], _range_error_m(flowing, *own))
        parts.append(Moved(*distances, *errors))
    return joined(parts)


def joined(parts: Sequence[Moved]) -> Moved:
    """Of several scans or objects."""
    return Moved(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _range_error_m(
    surfels: Surfels, origin_m: np.ndarray, direction: np.ndarray, range_m: np.ndarray
) -> np.ndarray:
    """Absolute range errors (r,) of what evidence alone renders; NaN where that is nothing."""
    rendered = reproject_rays(
        surfels, origin_m, direction, np.ones(len(range_m), np.float32), most=_MOST_SURFACES, far_m=2 * _FAR_M
    )
    error = np.abs(rendered.range_m - range_m)
    return np.where(np.isfinite(error), error, np.nan)


class AboveGround(NamedTuple):
    """Returns of what stands, as high above the ground as people and vehicles are; (n, 2) each."""

    distance_m: np.ndarray
    """Distance to its surface as 4 other scans show it, and range."""
    error_m: np.ndarray
    """Range error of what these scans' surfels give, and range."""


def standing_returns(store: SceneStore, objects: tuple[ObjectEvidence, ...]) -> AboveGround:
    """Figures of what stands; what moves is left out, and what is near its path."""
    sweeps = read_sweeps(store)
    assert sweeps is not None
    returns = training_returns(sweeps)
    kept = np.repeat(sweeps.is_training, np.diff(sweeps.arrays["offsets"]))
    a = {name: sweeps.arrays[name][kept] for name in ("origin_m", "direction", "range_m", "intensity")}
    scan = returns.scan_of(np.arange(len(kept[kept])))
    stands = ~returns.is_own_vehicle
    height_m = build_ground(returns.point_m[stands]).above(returns.point_m)
    for one in objects:
        local = one.path.to_object(returns.point_m.astype(np.float64), returns.time_s)
        stands &= ~np.all((local > one.path.low_m - 0.3) & (local < one.path.high_m + 0.3), axis=1)
    used = stands & (height_m > ABOVE_GROUND_M) & (height_m < _HIGHEST_M)
    used &= (a["range_m"] > _NEAR_M) & (a["range_m"] < _FAR_M)
    random, distances, errors = np.random.default_rng(0), [np.zeros((0, 2))], [np.zeros((0, 2))]
    for k in range(returns.scan_count):
        others = np.argsort(np.abs(np.arange(returns.scan_count) - k), kind="stable")[1 : NEAREST_SCANS + 1]
        near, mine = np.isin(scan, others), np.flatnonzero(used & (scan == k))
        if len(mine) == 0 or (used & near).sum() < PLANE_POINTS:
            continue
        mine = random.choice(mine, min(len(mine), _STANDING_A_SCAN), replace=False)
        seen = returns.point_m[used & near].astype(np.float64)
        off_m = surface_distance_m(returns.point_m[mine], seen)
        distances.append(np.stack([off_m, a["range_m"][mine]], axis=1))
        if k % _RENDERED_EVERY == 0:
            surfels = build_surfels(
                a["origin_m"][near], a["direction"][near], a["range_m"][near], a["intensity"][near],
                voxel_m=OBJECT_VOXEL_M, is_surface=stands[near],
            )  # fmt: skip
            off_m = _range_error_m(surfels, *(a[name][mine] for name in ("origin_m", "direction", "range_m")))
            errors.append(np.stack([off_m, a["range_m"][mine]], axis=1))
    return AboveGround(np.concatenate(distances), np.concatenate(errors))


def figures(distance_m: np.ndarray) -> dict[str, float]:
    """Median, 90th percentile, share farther off than 10 cm, share of places that others never saw."""
    known = distance_m[np.isfinite(distance_m)]
    return {
        "returns": len(distance_m), "median_m": float(np.median(known)),
        "p90_m": float(np.quantile(known, 0.9)), "far_off_share": float((known > FAR_OFF_M).mean()),
        "unseen_share": 1.0 - len(known) / len(distance_m),
    }  # fmt: skip


def like(static: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    """Distances (n,) of static returns at the ranges of some others, as many at each as those are."""
    random, low = np.random.default_rng(0), np.quantile(range_m, [0.0, 0.25, 0.5, 0.75, 1.0])
    parts = [static[(static[:, 1] >= a) & (static[:, 1] <= b), 0] for a, b in itertools.pairwise(low)]
    count = min((len(part) for part in parts if len(part)), default=0)
    return np.concatenate([random.choice(part, count, replace=False) for part in parts if len(part)])


def measure(store: SceneStore) -> dict[str, Any]:
    """All figures of a scene whose evidence lies published."""
    evidence = read_evidence(store)
    if evidence is None or evidence.dynamic is None:
        raise SystemExit(f"scene {store.scene}: nothing was seen to move")
    objects = evidence.dynamic.objects
    static = standing_returns(store, objects)
    total = int(evidence.prior.is_hit.sum())
    rows, kinds = [], dict[str, list[Moved]]()
    for number, one in enumerate(objects):
        found, size_m = moved_object(one), one.path.high_m - one.path.low_m
        if len(found.range_m) == 0:
            continue
        kind = "vehicle" if size_m[:2].max() >= VEHICLE_M else "person"
        kinds.setdefault(kind, []).append(found)
        if len(found.range_m) >= FEWEST_RETURNS:
            rows.append(_row(f"object {number}, {kind}", found, static, total) | {
                "size_m": [round(float(side), 2) for side in size_m], "scans": len(one.path.scan),
                "has_flow": one.flow_m is not None,
            })  # fmt: skip
    for kind, parts in kinds.items():
        row = _row(f"all of kind {kind}", joined(parts), static, total)
        rows.append(row | {"objects": len(parts), "has_flow": False})
    return {"scene": store.scene, "returns": total, "rows": rows}


def _row(name: str, moved: Moved, static: AboveGround, total: int) -> dict[str, Any]:
    row: dict[str, Any] = {
        "name": name, "range_m": float(np.median(moved.range_m)),
        "rigid": figures(moved.distance_m), "if_it_stood": figures(moved.static_m),
        "standing": figures(like(static.distance_m, moved.range_m)),
        "rendered": figures(moved.error_m), "flowing": figures(moved.flowing_m),
        "standing_rendered": figures(like(static.error_m, moved.error_range_m)),
    }  # fmt: skip
    excess = row["rendered"]["far_off_share"] - row["standing_rendered"]["far_off_share"]
    row["excess_share_of_all_returns"] = max(0.0, excess) * len(moved.error_m) / total
    return row


def table(found: dict[str, Any]) -> str:
    """Markdown of what `measure` gave."""
    head = [
        "what", "returns", "range m", "to its surface: rigid", "standing", "as if it stood", "range: rigid",
        "as shown", "standing", "> 10 cm, rigid", "as shown", "standing", "excess, of all returns",
    ]  # fmt: skip
    rows = [
        [
            row["name"] + (", with a flow" if row["has_flow"] else ""), row["rigid"]["returns"],
            f"{row['range_m']:.1f}", *(_both(row[name]) for name in ("rigid", "standing", "if_it_stood")),
            *(_both(row[name]) for name in _SHOWN), *(f"{row[name]['far_off_share']:.1%}" for name in _SHOWN),
            f"{row['excess_share_of_all_returns']:.3%}",
        ]
        for row in found["rows"]
    ]  # fmt: skip
    return markdown_table(head, rows, "|---|" + "---:|" * (len(head) - 1))


def write_section(found: dict[str, Any]) -> None:
    """The figures in docs/lean_ablation.md."""
    about = f"{found['machine']}; commit {found['commit']}.\n\n"
    write_between(DOCUMENT, "rigidity", about + table(found))


def _both(one: dict[str, float]) -> str:
    """Median / 90th percentile in millimetres."""
    return f"{1e3 * one['median_m']:.0f} / {1e3 * one['p90_m']:.0f}"


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="kitti0005_van_cyclist")
    arguments = parser.parse_args()
    found = measure(SceneStore(home=home_from_environment(os.environ), scene=arguments.scene))
    write_measured(RESULTS, found)
    write_section(json.loads(RESULTS.read_text()))
    print(table(found))


if __name__ == "__main__":
    main()
