"""All evidence of one scene in one object, converted to and from named arrays for the store."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.evidence.moving.object_evidence import MovingObject, ObjectEvidence, ObjectRays
from nvsf_core.evidence.stationary_scans import StationaryScans
from nvsf_core.evidence.surfels import Surfels

_RENDERED = "rendered_"
_LEFT_OUT, _LEFT_OUT_RENDERED = "left_out_", "left_out_rendered_"
_GAPS = "unit_gaps"
_PATH = ("scan", "time_s", "pose")
ALL, MOST, NEVER = 1.0, 0.51, float("inf")
"""Least share of the scans beside that returned, for a ray that meets no surface to be copied from them."""


@dataclass(frozen=True, slots=True)
class LeftOutEvidence:
    """Static surfels built without the validation scans."""

    validation: np.ndarray
    """(j,) int64 ascending: the validation scans' numbers among the training scans."""
    static: Surfels
    """In voxels of the size that fields use."""
    rendered: Surfels | None = None
    """Like `SceneEvidence.rendered`; None where that is None."""

    @property
    def for_rendering(self) -> Surfels:
        """Surfels for `reproject`, the renderer without learning."""
        return self.static if self.rendered is None else self.rendered

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Named arrays that `from_arrays` reads back."""
        own = {} if self.rendered is None else _prefixed(_LEFT_OUT_RENDERED, self.rendered)
        return {"left_out_scans": self.validation} | _prefixed(_LEFT_OUT, self.static) | own

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> "LeftOutEvidence | None":
        """Read back what `to_arrays` gave; None where no scan was left out."""
        static = _surfels(_LEFT_OUT, arrays)
        if static is None:
            return None
        return LeftOutEvidence(arrays["left_out_scans"], static, _surfels(_LEFT_OUT_RENDERED, arrays))


@dataclass(frozen=True, slots=True)
class SceneEvidence:
    """One scene's evidence, scene-local metres."""

    static: Surfels
    """Of the static scene, in voxels of the sizes that fields use; rays that end on moving objects count as
    passing through, too."""
    prior: DropPrior
    lasers: np.ndarray
    """(l,) int16: lasers that ever returned, from the top."""
    firings: np.ndarray
    """(n,) int32: firings in one sweep, for each training scan."""
    own_range_m: np.ndarray
    """(lasers, cells) float32 metres: range of the own vehicle by laser and azimuth cell; 0 = not on it."""
    own_intensity: np.ndarray
    """(lasers, cells) float32, 0..1."""
    objects: tuple[ObjectEvidence, ...] = ()
    """The moving objects."""
    stationary: StationaryScans | None = None
    """None where the sensor never stood or crawled."""
    rendered: Surfels | None = None
    """Static surfels with shapes, in the voxel size that suits `reproject` best; None = `static`."""
    left_out: LeftOutEvidence | None = None
    """To compare candidates on the validation scans; None where there are too few scans to leave any out."""
    unit_gaps: np.ndarray | None = None
    """(lasers, cells) bool: firings of the recorded unit that never return, from `find_unit_gaps`; None where
    the sensor moved too little to tell."""
    copied_share: float = ALL
    """A ray that meets no surface is copied from the scans beside where at least this share of them returned,
    `ALL`, `MOST` or `NEVER`."""

    @property
    def for_rendering(self) -> Surfels:
        """Static surfels for `reproject`, the renderer without learning."""
        return self.static if self.rendered is None else self.rendered

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Named arrays that `from_arrays` reads back."""
        moving = _object_arrays(self.objects) if self.objects else {}
        stationary = {} if self.stationary is None else self.stationary.to_arrays()
        rendered = {} if self.rendered is None else _prefixed(_RENDERED, self.rendered)
        left_out = {} if self.left_out is None else self.left_out.to_arrays()
        gaps = {} if self.unit_gaps is None else {_GAPS: self.unit_gaps}
        return self.static.to_arrays() | moving | stationary | rendered | left_out | gaps | {
            "prior_time_s": self.prior.time_s, "prior_fraction": self.prior.fraction,
            "prior_is_hit": self.prior.is_hit, "lasers": self.lasers, "firings": self.firings,
            "own_range_m": self.own_range_m, "own_intensity": self.own_intensity,
            "copied_share": np.array(self.copied_share, np.float32),
        }  # fmt: skip

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> "SceneEvidence":
        """Read back what `to_arrays` gave."""
        a = arrays
        prior = DropPrior(a["prior_time_s"], a["prior_fraction"], a["prior_is_hit"])
        return SceneEvidence(
            static=Surfels.from_arrays(a), prior=prior, lasers=a["lasers"], firings=a["firings"],
            own_range_m=a["own_range_m"], own_intensity=a["own_intensity"],
            objects=_objects_from(a), stationary=StationaryScans.from_arrays(a),
            rendered=_surfels(_RENDERED, a), left_out=LeftOutEvidence.from_arrays(a),
            unit_gaps=a.get(_GAPS), copied_share=float(a["copied_share"].item()),
        )  # fmt: skip


def _object_arrays(objects: tuple[ObjectEvidence, ...]) -> dict[str, np.ndarray]:
    """Named arrays of moving objects, at least one, that `_objects_from` reads back."""
    paths, rays = [one.path for one in objects], [one.rays for one in objects]
    arrays = {
        "object_path_offsets": _offsets([len(path.scan) for path in paths]),
        "object_ray_offsets": _offsets([len(one.scan) for one in rays]),
        "object_bounds_m": np.array([[path.low_m, path.high_m] for path in paths], np.float64),
        "object_frame_s": np.array([path.frame_s for path in paths], np.float64),
        "object_voxel_m": np.array([one.voxel_m for one in objects], np.float64),
    }
    for number, one in enumerate(objects):
        if one.flow_m is not None:
            arrays[f"object_flow_m_{number}"] = one.flow_m
    for name in _PATH:
        arrays[f"object_path_{name}"] = np.concatenate([getattr(path, name) for path in paths])
    for name in ObjectRays.__slots__:
        arrays[f"object_ray_{name}"] = np.concatenate([getattr(one, name) for one in rays])
    return arrays


def _objects_from(arrays: dict[str, np.ndarray]) -> tuple[ObjectEvidence, ...]:
    """Read back what `_object_arrays` gave; empty where nothing moves."""
    objects = []
    for number, frame_s in enumerate(arrays.get("object_frame_s", ())):
        path = slice(*arrays["object_path_offsets"][number : number + 2].tolist())
        rays = slice(*arrays["object_ray_offsets"][number : number + 2].tolist())
        low_m, high_m = arrays["object_bounds_m"][number]
        way = {name: arrays[f"object_path_{name}"][path] for name in _PATH}
        objects.append(
            ObjectEvidence(
                MovingObject(**way, frame_s=float(frame_s), low_m=low_m, high_m=high_m),
                ObjectRays(*(arrays[f"object_ray_{name}"][rays] for name in ObjectRays.__slots__)),
                float(arrays["object_voxel_m"][number]),
                arrays.get(f"object_flow_m_{number}"),
            )
        )
    return tuple(objects)


def _prefixed(prefix: str, surfels: Surfels) -> dict[str, np.ndarray]:
    return {prefix + name: value for name, value in surfels.to_arrays().items()}


def _surfels(prefix: str, arrays: dict[str, np.ndarray]) -> Surfels | None:
    """Surfels from arrays whose names have a prefix; None where one is missing."""
    if not all(prefix + name in arrays for name in Surfels.ARRAYS):
        return None
    return Surfels.from_arrays({name: arrays[prefix + name] for name in Surfels.ARRAYS})


def _offsets(lengths: list[int]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
