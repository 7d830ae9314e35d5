"""Checks of stored views: numbers are finite and within limits, and scans are like the training scans."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.metrics.norms import ScanNorms
from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.sensors.tables import sensor_table
from nvsf_core.stages.checks.declared import FINITE, RETURNS, VIEW_HIT_RATE, VIEW_INTENSITY, WITHIN
from nvsf_core.stages.checks.norms import (
    LEVER,
    NO_NORMS,
    Apart,
    check_likeness,
    read_norms,
)
from nvsf_core.stages.runner.stage import Check, NamedCheck, Task
from nvsf_core.stores.arrays import array_names, holds_array, read_arrays, read_attrs
from nvsf_core.stores.scene_store import SceneStore

_SHARES = ("intensity", "pano_intensity", "pano_hit", "grid_hit", "grid_intensity", "ray_intensity")
_GRIDS_M = ("pano_range_m", "grid_range_m")
"""Ranges that are 0 for no return; other ranges, along recorded rays or pixels, are infinite there."""
_RANGES_M = (*_GRIDS_M, "ray_range_m")
_MODEL = "model"

_View = tuple[str, Mapping[str, np.ndarray], Mapping[str, Any]]
"""Name of a view; arrays and attributes of the model's scans."""


@dataclass(slots=True)
class _Count:
    """Counts of checked and of wrong numbers, and where the wrong ones are."""

    total: int = 0
    wrong: int = 0
    places: list[str] = field(default_factory=list)

    def add(self, total: int, wrong: int, place: str) -> None:
        self.total += total
        self.wrong += wrong
        if wrong:
            self.places.append(f"{wrong} of {total} in {place}")

    def outcome(self, named: NamedCheck, fault: str) -> Check:
        share = self.wrong / max(1, self.total)
        found = "; ".join(self.places) if self.places else f"none of {self.total:,} numbers"
        return named.outcome(share, 0.0, f"{fault}: {found}")


def check_views(task: Task) -> list[Check]:
    """Check all views in the task's folder.

    Returns:
        One outcome per check of the stage that is made here.
    """
    finite, within = _Count(), _Count()
    scans = list[_View]()
    for path in sorted(task.folder.glob("*/*.zarr")):
        place = f"{path.parent.name}/{path.stem}"
        arrays, attrs = _numbers(path), read_attrs(path)
        for name, values in arrays.items():
            finite.add(values.size, _broken(name, values), f"{place}, {name}")
        if path.stem == _MODEL and attrs.get("sensor"):
            _limits(within, place, arrays, _max_range_m(attrs) * LEVER)
            scans.append((path.parent.name, arrays, attrs))
    norms = read_norms(task.store)
    checks = [finite.outcome(FINITE, "not finite"), within.outcome(WITHIN, "out of limits")]
    if norms is None:
        return [*checks, *(named.not_run(NO_NORMS) for named in (RETURNS, VIEW_HIT_RATE, VIEW_INTENSITY))]
    return [*checks, _empty(scans, norms), *_likeness(scans, norms, task.store)]


def _max_range_m(attrs: Mapping[str, Any]) -> float:
    """Greatest range of the view's LiDAR: stored with it, for a user's own sensor is no known table."""
    stored = attrs.get("sensor_max_range_m")
    return sensor_table(attrs["sensor"]).max_range_m if stored is None else float(stored)


def _numbers(path: Path) -> dict[str, np.ndarray]:
    """All floating point arrays of a view, with `offsets` and `frame`."""
    floating = array_names(path, "f")
    more = [name for name in ("offsets", "frame") if holds_array(path, name)]
    return read_arrays(path, *floating, *more)


def _broken(name: str, values: np.ndarray) -> int:
    may_be_unanswered = name.endswith("_range_m") and name not in _GRIDS_M
    sound = ~np.isnan(values) & (values != -np.inf) if may_be_unanswered else np.isfinite(values)
    return int(values.size - np.count_nonzero(sound))


def _limits(within: _Count, place: str, arrays: Mapping[str, np.ndarray], far_m: float) -> None:
    """Count values out of limits; values that are not finite are counted elsewhere."""
    for name in (*_SHARES, *_RANGES_M):
        if name in arrays:
            values, top = arrays[name], 1.0 if name in _SHARES else far_m
            # Float32 rounding may carry a probability beyond 1.
            wrong = (values < -1e-6) | ((values > top * (1.0 + 1e-6)) & np.isfinite(values))
            within.add(values.size, int(np.count_nonzero(wrong)), f"{place}, {name}")
    if "points_m" in arrays:
        range_m = np.linalg.norm(arrays["points_m"].astype(np.float64), axis=1)
        wrong = (range_m > far_m) & np.isfinite(range_m)
        within.add(range_m.size, int(np.count_nonzero(wrong)), f"{place}, points_m (up to {far_m:.0f} m)")


def _empty(scans: list[_View], norms: ScanNorms) -> Check:
    held_out = [arrays for view, arrays, _ in scans if view == HELD_OUT]
    if not held_out:
        return RETURNS.not_run("no held-out scan was rendered")
    returns, time_s = np.diff(held_out[0]["offsets"]), held_out[0]["time_s"]
    # Where training scans have hardly any returns, an empty scan is correct.
    empty = sum(
        abs(norms.hit_rate_apart(0, float(instant))) > norms.hit_rate_limit
        for instant in time_s[returns == 0]
    )
    detail = f"{empty} of {len(returns)} held-out scans without a return where training scans have them"
    return RETURNS.outcome(empty / max(1, len(returns)), 0.5, detail)


def _likeness(scans: list[_View], norms: ScanNorms, store: SceneStore) -> list[Check]:
    rates, spreads = Apart(), Apart()
    recorded = store.require("sweeps") / "returns.zarr"
    sensor, a = str(read_attrs(recorded).get("sensor", "")), read_arrays(recorded, "frame", "time_s")
    for view, arrays, attrs in scans:
        if attrs["sensor"] != sensor:
            continue  # other lasers hit other surfaces: recorded scans are not comparable
        # Of a frozen instant the scans that are nearest in time are elsewhere: the path's moments count. A
        # path of one's own is at other places at those, and at the frames' that are nearest in place.
        moments = arrays.get("path_time_s", arrays["time_s"])
        if "path_knot_s" in arrays:
            moments = np.interp(arrays["frame"], a["frame"], a["time_s"])
        for i, (frame, time_s) in enumerate(zip(arrays["frame"], moments, strict=True)):
            own = arrays["intensity"][arrays["offsets"][i] : arrays["offsets"][i + 1]]
            place = f"view {view}, frame {frame}"
            rates.append((norms.hit_rate_apart(len(own), float(time_s)), place))
            if len(own) and np.isfinite(own).all():
                spreads.append((norms.intensities_apart(own, float(time_s)), place))
    return check_likeness(VIEW_HIT_RATE, VIEW_INTENSITY, rates, spreads, norms)
