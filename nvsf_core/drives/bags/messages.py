"""Decoding of ROS messages that drives are made of: point clouds, images, camera infos."""

from typing import Any

import cv2
import numpy as np

from nvsf_core.errors import CalibrationError, DataError

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
ODOMETRY = "nav_msgs/msg/Odometry"
KINDS = (POINT_CLOUD, *IMAGES, CAMERA_INFO, *TRANSFORMS, ODOMETRY)
"""Of messages that are read."""
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_TIMES = ("time", "t", "timestamp", "time_stamp", "offset_time", "time_offset")
_RINGS = ("ring", "channel", "line", "row")
_INTENSITIES = ("intensity", "reflectivity", "i")
_COLOURS = {
    "rgb8": None, "bgr8": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB, "8UC1": cv2.COLOR_GRAY2RGB, "8UC3": cv2.COLOR_BGR2RGB,
    # OpenCV names a Bayer pattern by its second row.
    "bayer_rggb8": cv2.COLOR_BayerBG2RGB, "bayer_bggr8": cv2.COLOR_BayerRG2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGR2RGB, "bayer_grbg8": cv2.COLOR_BayerGB2RGB,
}  # fmt: skip
_CHANNELS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4}
_LENSES = {"": "pinhole", "plumb_bob": "pinhole", "rational_polynomial": "pinhole",
           "equidistant": "fisheye", "fisheye": "fisheye"}  # fmt: skip
_FAR_APART = 0.05
"""Difference of two cameras' focal lengths or axes, in focal lengths, from which images would not fit."""
_POLYNOMIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def cloud_columns(message: Any, where: str) -> dict[str, np.ndarray]:
    """Columns of a PointCloud2: x, y, z, and, where present, intensity, `ring`, and `time` as recorded.

    Points without a return (NaN) are left out.

    Raises:
        DataError: Its fields do not fit its bytes, or one of x, y, z is absent.
    """
    order = ">" if message.is_bigendian else "<"
    names, kinds, offsets = [], [], []
    for one in message.fields:
        if one.datatype in _FIELD_TYPES and one.count in (0, 1) and one.name not in names:
            names.append(one.name)
            kinds.append(order + _FIELD_TYPES[one.datatype])
            offsets.append(one.offset)
    count = message.width * message.height
    data = np.asarray(message.data, np.uint8).tobytes()
    row_bytes = message.width * message.point_step
    # Of a single row many drivers leave `row_step` at 0.
    is_cut = message.height > 1 and not row_bytes <= message.row_step <= len(data) // message.height
    if is_cut or not message.point_step or count > len(data) // message.point_step:
        raise DataError(
            f"{where}: expected {message.height} rows of {message.width} points of {message.point_step} "
            f"bytes, found {len(data)} bytes"
        )
    try:
        kind = np.dtype(
            {"names": names, "formats": kinds, "offsets": offsets, "itemsize": message.point_step}
        )
        # Rows may be padded.
        steps = (message.row_step, message.point_step)
        points = np.ndarray((message.height, message.width), kind, data, 0, steps).reshape(-1)
    except ValueError as error:
        raise DataError(f"{where}: a point cloud whose fields do not fit its bytes ({error})") from error
    if not {"x", "y", "z"} <= set(names):
        raise DataError(f"{where}: expected x, y, z of each point, found {', '.join(names)!s:.200}")
    points = points[np.isfinite(np.stack([points[name] for name in "xyz"])).all(axis=0)]
    found = {name: points[name] for name in "xyz"}
    for column, known in (("intensity", _INTENSITIES), ("ring", _RINGS), ("time", _TIMES)):
        own = next((name for name in known if name in names), None)
        if own is not None:
            found[column] = points[own]
    return found


def tells_lasers(message: Any) -> bool:
    """Whether a PointCloud2 gives each point's laser or time, as those of rotating LiDARs do."""
    return any(one.name in (*_RINGS, *_TIMES) for one in message.fields)


def stamp_s(message: Any) -> float:
    """Seconds of a message's header."""
    stamp = message.header.stamp
    return float(stamp.sec) + 1e-9 * float(getattr(stamp, "nanosec", 0))


def image_rgb(message: Any, where: str, decode: Any) -> np.ndarray:
    """Pixels (H, W, 3) uint8, red first, of an Image or a CompressedImage.

    Raises:
        DataError: It is of an encoding that is not read, or cut.
    """
    if not hasattr(message, "encoding"):
        return np.asarray(decode(np.asarray(message.data, np.uint8).tobytes()))
    fault = encoding_fault(message)
    if fault is not None:
        raise DataError(f"{where}: {fault}")
    encoding = message.encoding
    channels = _CHANNELS.get(encoding, 1)
    data = np.asarray(message.data, np.uint8)
    is_empty = 0 in (message.height, message.width)
    if is_empty or len(data) < message.height * message.step or message.step < message.width * channels:
        raise DataError(
            f"{where}: expected {message.height} rows of {message.width} pixels in {message.step} bytes, "
            f"found {len(data)} bytes"
        )
    rows = data[: message.height * message.step].reshape(message.height, message.step)
    pixels = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    code = _COLOURS[encoding]
    return np.ascontiguousarray(pixels if code is None else cv2.cvtColor(np.ascontiguousarray(pixels), code))


def encoding_fault(message: Any) -> str | None:
    """Why an Image is of an encoding that is not read, as a depth camera's; None if it is read."""
    encoding = getattr(message, "encoding", None)
    if encoding is None or encoding in _COLOURS:
        return None
    return f"encoding: expected one of {', '.join(_COLOURS)}, found {encoding!r:.40}"


def lens_facts(message: Any, where: str, *, is_rectified: bool) -> dict[str, Any]:
    """A CameraInfo as `lens_of` reads it.

    Args:
        message: The message.
        where: Its topic, for messages.
        is_rectified: Whether the images are rectified: then `P` holds, or `K` where it is 0, without
            distortion. `P` also holds where `K` is 0.

    Raises:
        CalibrationError: It is uncalibrated, or of a model that is not read.
    """
    k, d, p = (info_numbers(message, name) for name in "kdp")
    model = str(message.distortion_model)
    size = {"width": int(message.width), "height": int(message.height)}
    if is_of_p(message, is_rectified=is_rectified) and len(p) == 12 and p[0] > 0.0:
        return {"model": "pinhole", **size, "fx": p[0], "fy": p[5], "cx": p[2], "cy": p[6]}
    if len(k) != 9 or k[0] == 0.0:
        raise CalibrationError(f"{where}: expected a calibrated camera, found K = {k.tolist()}")
    if is_rectified:
        return {"model": "pinhole", **size, "fx": k[0], "fy": k[4], "cx": k[2], "cy": k[5]}
    if model == "mei":  # as this project's own bags have it
        mei = dict(zip(("xi", "k1", "k2", "p1", "p2"), d.tolist(), strict=False))
        return {"model": "mei", **size, **mei, "gamma1": k[0], "gamma2": k[4], "u0": k[2], "v0": k[5]}
    if model not in _LENSES and d.any():
        raise CalibrationError(
            f"{where}: distortion_model: expected one of {', '.join(filter(None, _LENSES))}, mei, found "
            f"{model!r:.40}"
        )
    lens = _LENSES.get(model, "pinhole")
    names = ("k1", "k2", "k3", "k4") if lens == "fisheye" else _POLYNOMIAL
    distortion = {name: float(value) for name, value in zip(names, d, strict=False)}
    return {
        "model": lens, **size, "fx": k[0], "fy": k[4], "cx": k[2], "cy": k[5], "distortion": distortion,
    }  # fmt: skip


def is_of_p(message: Any, *, is_rectified: bool) -> bool:
    """Whether images are of the camera that `R` and `P` describe: rectified ones, and all where `K` is 0."""
    return is_rectified or not info_numbers(message, "k").any()


def has_two_cameras(message: Any) -> bool:
    """Whether `K` and `P` of a CameraInfo are far apart: it matters of which of them the images are."""
    k, p = info_numbers(message, "k"), info_numbers(message, "p")
    if len(k) != 9 or len(p) != 12 or k[0] <= 0.0 or p[0] <= 0.0:
        return False
    apart_px = np.abs(p[[0, 5, 2, 6]] - k[[0, 4, 2, 5]])
    return bool(apart_px.max() > _FAR_APART * k[0])


def info_numbers(message: Any, name: str) -> np.ndarray:
    """A matrix or list of a CameraInfo, row by row; ROS 1 has its names in capitals."""
    return np.asarray(getattr(message, name, getattr(message, name.upper(), ())), np.float64).reshape(-1)
