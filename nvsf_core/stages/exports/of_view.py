"""A rendered view as a data set: its returns and their noise sampled, its images, cameras and boxes."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from nvsf_core.drives.kitti360.writer import UNDATED_S
from nvsf_core.drives.view_entry import MEASURED, ViewEntry
from nvsf_core.errors import DataError
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.sensors.sweep_clock import SweepClock
from nvsf_core.simulation.raydrop import SAMPLING_SHARPNESS
from nvsf_core.simulation.scan import GRID_ARRAYS, RANGE_NOISE_M, sample_scan
from nvsf_core.stages.exports.records import BoxRecord, CameraRecord, DataSet, ImageRecord, ScanRecord
from nvsf_core.stages.runner.stage import RunConfig
from nvsf_core.stages.views.files import cameras_of, file_numbers
from nvsf_core.stages.views.instances import depth_m, object_ids
from nvsf_core.stages.views.view import camera_models


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RenderedView:
    """A rendered view as it is stored, and what was asked for."""

    scene: str
    sequence: str
    entry: ViewEntry
    config: RunConfig
    arrays: Mapping[str, np.ndarray]
    attrs: Mapping[str, Any]
    origin_s: float | None = None
    """Seconds from 1970-01-01 to 0 s of the scene; None = not known."""

    @property
    def range_noise_m(self) -> float:
        """Standard deviation of the noise that its ranges get.

        Raises:
            DataError: The measured one is asked for and the drive's scans do not tell it.
        """
        asked = self.entry.range_noise_m
        if asked is None:
            return RANGE_NOISE_M
        if asked != MEASURED:
            return float(asked)
        measured = self.attrs.get("measured_range_noise_m")
        if measured is None:
            raise DataError(
                f"view {self.entry.name}: range_noise_m: expected scans whose firings are known, found none; "
                "give metres instead of `measured`"
            )
        return float(measured)

    def what_was_sampled(self) -> dict[str, Any]:
        """The manifest's words on what is random."""
        if "points_m" not in self.arrays:
            return {"hits": "nothing: no LiDAR", "range_noise_m": 0.0}
        if self.entry.hits == "threshold":
            return {"hits": "as rendered (the most likely returns)", "range_noise_m": self.range_noise_m}
        return {
            "hits": "drawn from the hit probability",
            "sharpness": SAMPLING_SHARPNESS,
            "range_noise_m": self.range_noise_m,
        }

    def scan(self, index: int) -> ScanRecord:
        """The scan of an instant: sampled from the rendered grid, with the data set's own seed."""
        a = self.arrays
        grid = {name: a[name][index] for name in GRID_ARRAYS}
        rows, ray = sample_scan(
            grid, np.random.default_rng([self.config.draw_seed, index, *self._words()]),
            self.range_noise_m, by_threshold=self.entry.hits == "threshold",
        )  # fmt: skip
        row, column = np.divmod(ray, grid[GRID_ARRAYS[0]].shape[1])
        fraction = (column + 0.5) / int(a["grid_firings"][index]) - 0.5
        elapsed = SweepClock.stored(a.get("sweep_clock"), index).elapsed(fraction)
        # Of one instant, times before it are -0 until 0 is added.
        offset_s = elapsed * float(self.attrs["sweep_period_s"]) + 0.0
        return ScanRecord(
            number=self.numbers[index],
            rows=rows,
            ring=np.asarray(self.attrs["grid_lasers"])[row].astype("<u2"),
            offset_s=offset_s.astype("<f4"),
            support=a["grid_support"][index].reshape(-1)[ray],
            stamp_s=float(a["stamp_s"][index]),
            time_s=float(a["time_s"][index]),
            lidar_to_world=a["lidar_to_world"][index],
        )

    @property
    def numbers(self) -> list[int]:
        """File numbers of the instants."""
        return file_numbers(self.arrays)

    def image_times(self, camera: str, index: int) -> dict[str, float]:
        """`time_s` and `stamp_s` of an image: of the sweep's, where images have no times of their own."""
        time_s = float(self.arrays[f"{camera}_time_s"][index])
        later_s = time_s - float(self.arrays["time_s"][index])
        return {"time_s": time_s, "stamp_s": float(self.arrays["stamp_s"][index]) + later_s}

    def data_set(self, boxes: Callable[[float], list[BoxRecord]]) -> DataSet:
        """The data set, for the formats that hold all of it.

        `boxes` gives the objects at an instant in seconds. A view of held-out frames may lack images:
        then its camera is left out of these formats.
        """
        a = self.arrays
        order = np.argsort(self.numbers)
        whole = [name for name in cameras_of(a) if np.array_equal(a[f"{name}_frame"], a["frame"])]
        models, mounts = camera_models(self.attrs), self.attrs["camera_in_lidar"]
        table = self.attrs["instances"]

        def image(camera: str, index: int) -> ImageRecord:
            at = int(order[index])
            instances = a.get(f"{camera}_instance")
            return ImageRecord(
                rgb=a[f"{camera}_rgb"][at],
                depth_m=depth_m(models[camera], a[f"{camera}_range_m"][at]),
                object_id=None if instances is None else object_ids(instances[at], table),
            )  # fmt: skip

        return DataSet(
            name=self.entry.name, sequence=self.sequence, numbers=np.sort(self.numbers).tolist(),
            stamp_s=a["stamp_s"][order], lidar_to_world=a["lidar_to_world"][order],
            sweep_period_s=float(self.attrs.get("sweep_period_s", 0.0)),
            origin_s=UNDATED_S if self.origin_s is None else self.origin_s,
            cameras={name: _camera(models[name], mounts[name]) for name in whole},
            scan=(lambda index: self.scan(int(order[index]))) if "points_m" in a else None,
            image=image, boxes=lambda index: boxes(float(a["time_s"][order[index]])),
        )  # fmt: skip

    def _words(self) -> list[int]:
        """The seed that scene, view, recipe and seed of training give."""
        recipe, seed = self.config.recipe.identity(), self.config.seed
        key = f"{self.scene} {self.entry.name} {recipe} {seed}"
        words: list[int] = np.frombuffer(hashlib.sha256(key.encode()).digest(), np.uint32).tolist()
        return words


def _camera(model: Pinhole | MeiFisheye, in_lidar: list[float]) -> CameraRecord:
    return CameraRecord(model=model, in_lidar=np.array(in_lidar, np.float64).reshape(4, 4))
