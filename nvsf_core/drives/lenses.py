"""Cameras with a distortion that the flow has no model of: their images are rectified as they are read.

The flow knows pinholes and MEI fisheyes. A camera with OpenCV's polynomial or fisheye distortion becomes a
pinhole of the same size all of whose pixels the lens saw (`rectification`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from nvsf_core.drives.rectification import DistortedLens, rectification
from nvsf_core.errors import CalibrationError
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole, intrinsics_fault, recorded_size_fault

_MEI = ("xi", "k1", "k2", "p1", "p2", "gamma1", "gamma2", "u0", "v0")
_POLYNOMIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""OpenCV's order; ROS names it `plumb_bob` (5) or `rational_polynomial` (8)."""
_FISHEYE = ("k1", "k2", "k3", "k4")
"""OpenCV's fisheye, ROS's `equidistant`: Kannala and Brandt's model."""
_FOCAL = ("fx", "fy", "cx", "cy")
_OWN_KEYS = {"pinhole": (*_FOCAL, "distortion"), "fisheye": (*_FOCAL, "distortion"), "mei": _MEI}
MODELS = tuple(_OWN_KEYS)


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """How a camera's recorded images become those that the flow reads."""

    intrinsics: Pinhole | MeiFisheye
    """Of the images that the flow reads."""
    maps: tuple[np.ndarray, np.ndarray] | None
    """For `cv2.remap` of a recorded image; None = it is used as it is."""

    def rectified(self, rgb: np.ndarray) -> np.ndarray:
        """A recorded image (height, width, 3) uint8 as `intrinsics` describe it."""
        if self.maps is None:
            return rgb
        across, down = self.maps
        # The outermost pixels lie a fraction of a pixel outside.
        return np.asarray(cv2.remap(rgb, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def lens_of(raw: Mapping[str, Any], where: str) -> Lens:
    """The lens of a camera's description.

    Args:
        raw: `model` (`pinhole`, `fisheye` or `mei`), `width`, `height`, and of a pinhole or fisheye `fx`,
            `fy`, `cx`, `cy` and `distortion`, names to numbers; of `mei` the model's nine numbers. Beside
            them there may be `camera_to_lidar`, which is not looked at.
        where: File and camera, for messages.

    Raises:
        CalibrationError: A key is missing or unknown, a value is unphysical, or the lens saw no such view.
    """
    model = raw.get("model", "pinhole")
    if model not in MODELS:
        raise CalibrationError(f"{where}: model: expected one of {', '.join(MODELS)}, found {model!r:.60}")
    known = ("model", "width", "height", *_OWN_KEYS[model], "camera_to_lidar")
    unknown = sorted(set(raw) - set(known))
    if unknown:  # a misspelt `distortion` would make a perfect pinhole of any lens
        raise CalibrationError(
            f"{where}: expected the keys of a {model}, {', '.join(known)}, found {unknown[0]!r:.60}; correct "
            "it, or take it out"
        )
    width, height = (_whole(raw, key, where) for key in ("width", "height"))
    too_small = recorded_size_fault(width, height)
    if too_small is not None:
        raise CalibrationError(f"{where}: {too_small}")
    if model == "mei":
        values = {key: _number(raw, key, where) for key in _MEI}
        return Lens(MeiFisheye(**values, width=width, height=height), None)
    fx, fy, cx, cy = (_number(raw, key, where) for key in _FOCAL)
    fault = intrinsics_fault((fx, fy), (cx, cy), (width, height))
    if fault is not None:
        raise CalibrationError(f"{where}: {fault}")
    given = raw.get("distortion") or {}
    names = _FISHEYE if model == "fisheye" else _POLYNOMIAL
    if not isinstance(given, Mapping) or not set(given) <= set(names):
        raise CalibrationError(
            f"{where}: distortion: expected numbers {', '.join(names)} by name, found {given!r:.100}"
        )
    distortion = np.array([_number(given, name, where) if name in given else 0.0 for name in names])
    if model == "pinhole" and not distortion.any():
        return Lens(Pinhole(fx, fy, cx, cy, width, height), None)
    lens = DistortedLens(
        np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), distortion, (width, height),
        is_fisheye=model == "fisheye",
    )  # fmt: skip
    try:
        seen, maps = rectification(lens)
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from error
    fx, fy, cx, cy = (float(seen[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    fault = intrinsics_fault((fx, fy), (cx, cy), (width, height))
    if fault is not None:
        raise CalibrationError(f"{where}: {fault} after its distortion is taken out; check `distortion`")
    return Lens(Pinhole(fx, fy, cx, cy, width, height), maps)


def _number(raw: Mapping[str, Any], key: str, where: str) -> float:
    value = raw.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < 1e9:
        raise CalibrationError(f"{where}: {key}: expected a number, found {value!r:.60}")
    return float(value)


def _whole(raw: Mapping[str, Any], key: str, where: str) -> int:
    value = _number(raw, key, where)
    if value != int(value) or value < 1:
        raise CalibrationError(f"{where}: {key}: expected a whole number of pixels, found {value:g}")
    return int(value)
