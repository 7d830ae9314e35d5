"""Point clouds with intensity as binary PLY, read and written with numpy alone."""

from pathlib import Path

import numpy as np

from nvsf_core.errors import DataError, ShapeError

_VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_END = b"end_header\n"


def write_ply(path: Path, points_m: np.ndarray, intensity: np.ndarray) -> None:
    """Write points (N, 3) in metres and intensity (N,) in 0..1 as float32, in the given order.

    Raises:
        ShapeError: The arrays do not belong together.
    """
    if points_m.ndim != 2 or points_m.shape[1] != 3 or intensity.shape != points_m.shape[:1]:
        raise ShapeError(
            f"{path}: expected points (N, 3) and intensity (N,), found {points_m.shape} and {intensity.shape}"
        )
    vertices = np.empty(len(points_m), _VERTEX)
    for axis, name in enumerate("xyz"):
        vertices[name] = points_m[:, axis]
    vertices["intensity"] = intensity
    properties = "".join(f"property float {name}\n" for name in _VERTEX.names or ())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{properties}"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as handle:
        handle.write(header.encode() + _END)
        vertices.tofile(handle)


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read points (N, 3) float32 in metres and intensity (N,) float32 from a binary PLY.

    Vertices must come first and hold `x y z intensity`; other scalar properties are passed over.

    Raises:
        DataError: It is no such file, or shorter than its header says.
    """
    content = path.read_bytes()
    end = content.find(_END)
    if not content.startswith(b"ply\n") or end < 0:
        raise DataError(f"{path}: expected a PLY header, found {content[:20]!r}; write it anew")
    count, vertex = _vertex_type(path, content[:end].decode("ascii", "replace").splitlines())
    start = end + len(_END)
    if len(content) < start + count * vertex.itemsize:
        raise DataError(
            f"{path}: expected {count} points of {vertex.itemsize} bytes, found {len(content) - start} bytes;"
            " the file was cut off, write it anew"
        )
    vertices = np.frombuffer(content, vertex, count, start)
    points_m = np.stack([vertices[name].astype(np.float32) for name in "xyz"], axis=1)
    return points_m, vertices["intensity"].astype(np.float32)


def _vertex_type(path: Path, header: list[str]) -> tuple[int, np.dtype[np.void]]:
    """Number of vertices and the type of one, from the header's lines."""
    if "format binary_little_endian 1.0" not in header:
        raise DataError(f"{path}: expected format binary_little_endian 1.0; other kinds are not read")
    words = [line.split() for line in header]
    elements = [w for w in words if w[:1] == ["element"]]
    if not elements or elements[0][1] != "vertex":
        raise DataError(f"{path}: expected `element vertex` first, found {elements[:1]}")
    first = words.index(elements[0])
    last = words.index(elements[1]) if len(elements) > 1 else len(words)
    fields = []
    for word in words[first + 1 : last]:
        if word[:1] != ["property"]:
            continue
        if len(word) != 3 or word[1] not in _TYPES:
            raise DataError(f"{path}: expected scalar properties, found {' '.join(word)!r}")
        fields.append((word[2], "<" + _TYPES[word[1]]))
    missing = {"x", "y", "z", "intensity"} - {name for name, _ in fields}
    if missing:
        raise DataError(f"{path}: expected properties x y z intensity, missing {sorted(missing)}")
    return int(elements[0][2]), np.dtype(fields)
