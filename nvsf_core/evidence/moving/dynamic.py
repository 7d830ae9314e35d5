"""What a scene has in addition where something moves; to and from named arrays for the store."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.moving.object_evidence import ObjectEvidence, ObjectRays
from nvsf_core.evidence.moving.rigid_path import MovingObject
from nvsf_core.evidence.static.surfels import Surfels

_PATH = ("scan", "time_s", "pose")
_RAYS = ("origin_m", "direction", "range_m", "intensity", "is_hit", "scan")


@dataclass(frozen=True, slots=True, eq=False)
class DynamicEvidence:
    """The scene without what moves, and what moves by itself; a static scene has none of this."""

    static: Surfels
    """Surfels of what stays; the objects' rays see through, too."""
    objects: tuple[ObjectEvidence, ...]
    """At least one."""

    @property
    def flowing(self) -> int:
        """How many of them have a flow, because no rigid motion explains how they move."""
        return sum(one.flow_m is not None for one in self.objects)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Named arrays that `from_arrays` reads back."""
        paths, rays = [one.path for one in self.objects], [one.rays for one in self.objects]
        arrays = {f"background_{name}": value for name, value in self.static.to_arrays().items()}
        arrays["object_path_offsets"] = _offsets([len(path.scan) for path in paths])
        arrays["object_ray_offsets"] = _offsets([len(one.scan) for one in rays])
        arrays["object_bounds_m"] = np.array([[path.low_m, path.high_m] for path in paths], np.float64)
        arrays["object_frame_s"] = np.array([path.frame_s for path in paths], np.float64)
        arrays["object_voxel_m"] = np.array([one.voxel_m for one in self.objects], np.float64)
        for number, one in enumerate(self.objects):
            if one.flow_m is not None:
                arrays[f"object_flow_m_{number}"] = one.flow_m
        for name in _PATH:
            arrays[f"object_path_{name}"] = np.concatenate([getattr(path, name) for path in paths])
        for name in _RAYS:
            arrays[f"object_ray_{name}"] = np.concatenate([getattr(one, name) for one in rays])
        return arrays

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> "DynamicEvidence | None":
        """Read back what `to_arrays` gave; None where nothing moves."""
        if "object_frame_s" not in arrays:
            return None
        objects = []
        for number, frame_s in enumerate(arrays["object_frame_s"]):
            path = slice(*arrays["object_path_offsets"][number : number + 2].tolist())
            rays = slice(*arrays["object_ray_offsets"][number : number + 2].tolist())
            low_m, high_m = arrays["object_bounds_m"][number]
            objects.append(
                ObjectEvidence(
                    MovingObject(
                        scan=arrays["object_path_scan"][path],
                        time_s=arrays["object_path_time_s"][path],
                        pose=arrays["object_path_pose"][path],
                        frame_s=float(frame_s),
                        low_m=low_m,
                        high_m=high_m,
                    ),
                    ObjectRays(*(arrays[f"object_ray_{name}"][rays] for name in _RAYS)),
                    float(arrays["object_voxel_m"][number]),
                    arrays.get(f"object_flow_m_{number}"),
                )
            )
        static = {name: arrays[f"background_{name}"] for name in Surfels.ARRAYS}
        return DynamicEvidence(Surfels.from_arrays(static), tuple(objects))


def _offsets(lengths: list[int]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
