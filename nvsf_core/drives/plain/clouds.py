"""Points of `.bin`, `.ply` and `.pcd` files, as columns by name."""

import io
from array import array
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nvsf_core.drives.kitti360.scans import MOST_RETURNS
from nvsf_core.errors import DataError

Columns = Mapping[str, np.ndarray]
_MOST_POINTS, _MOST_BYTES = 4_000_000, 256
"""Of a file, and of one of its points."""
MOST_FILE_BYTES = _MOST_BYTES * MOST_RETURNS
"""Of a file, and of what a packed one becomes."""
_LONGEST_LINE = 65_536
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_PLY_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_PCD_TYPES = {"F": "f", "I": "i", "U": "u"}


def read_bin(path: Path, data: bytes) -> dict[str, np.ndarray]:
    """Columns x, y, z, intensity of float32 rows.

    Raises:
        DataError: The bytes are no whole rows.
    """
    if len(data) % 16:
        raise DataError(f"{path}: expected rows of 16 bytes (float32 x, y, z, intensity), found {len(data)}")
    rows = np.frombuffer(data, "<f4").reshape(-1, 4)
    return {name: rows[:, k] for k, name in enumerate(("x", "y", "z", "intensity"))}


def read_ply(path: Path, data: bytes) -> dict[str, np.ndarray]:
    """Columns of the element `vertex` of a PLY, ASCII or binary; it comes first.

    Raises:
        DataError: It is no such PLY, or is cut.
    """
    head, end, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not end:
        raise DataError(f"{path}: expected a PLY with a header, found none; copy it again")
    body = body.partition(b"\n")[2]
    order, count, names, elements = "?", -1, list[tuple[str, str]](), 0
    for line in head.decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            order = _PLY_FORMATS.get(words[1], "?")
        elif words[:1] == ["element"] and len(words) == 3:
            elements += 1
            # Python refuses to read thousands of digits by an error of its own.
            is_count = words[2].isdecimal() and len(words[2]) < 12
            if elements == 1 and words[1] == "vertex" and is_count:
                count = int(words[2])
        elif words[:1] == ["property"] and elements == 1:
            if len(words) != 3 or words[1] not in _PLY_TYPES:
                raise DataError(f"{path}: expected numbers as properties of a vertex, found {line!r:.60}")
            names.append((words[2], _PLY_TYPES[words[1]]))
    if order == "?" or not 0 <= count <= _MOST_POINTS or len(dict(names)) != len(names):
        raise DataError(
            f"{path}: expected a PLY whose first element is `vertex`, of at most {_MOST_POINTS:,} points "
            "with different properties; found another"
        )
    if order == "":
        return _of_text(path, body, count, dict(names))
    return _of_rows(path, body, count, np.dtype([(name, order + kind) for name, kind in names]))


def read_pcd(path: Path, data: bytes) -> dict[str, np.ndarray]:
    """Columns of a PCD: ASCII, binary or binary_compressed. Fields of more than one number are left out.

    Raises:
        DataError: It is no such PCD, or is cut.
    """
    head: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in head:
        end = data.find(b"\n", position)
        if end < 0 or end - position > 10_000 or position > 100_000:
            raise DataError(f"{path}: expected a PCD with a line DATA, found none; copy it again")
        words = data[position:end].decode("ascii", "replace").split()
        if words and not words[0].startswith("#"):
            head[words[0]] = words[1:]
        position = end + 1
    body = data[position:]
    try:
        sizes, kinds = head["SIZE"], [_PCD_TYPES[one] for one in head["TYPE"]]
        counts = [int(one) for one in head.get("COUNT", ["1"] * len(sizes))]
        count = int((head.get("POINTS") or [str(int(head["WIDTH"][0]) * int(head["HEIGHT"][0]))])[0])
        fields = [
            (name if name != "_" else f"_{k}", f"<{kind}{size}", (n,))
            for k, (name, kind, size, n) in enumerate(zip(head["FIELDS"], kinds, sizes, counts, strict=True))
        ]
        kind = np.dtype(fields)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise DataError(f"{path}: its header is no PCD's ({error!r:.60}); copy it again") from error
    if not 0 <= count <= _MOST_POINTS:
        raise DataError(f"{path}: expected at most {_MOST_POINTS:,} points, found {count:,}")
    if not 0 < kind.itemsize <= _MOST_BYTES:
        raise DataError(
            f"{path}: expected 1 to {_MOST_BYTES} bytes a point, found {kind.itemsize}; copy it again"
        )
    storage = head["DATA"][:1]
    single = [name for name, _, n in fields if n == (1,)]
    if storage == ["ascii"]:
        wide = {f"{name}.{k}" if n != (1,) else name: one for name, one, n in fields for k in range(n[0])}
        found = _of_text(path, body, count, wide)
        return {name: found[name] for name in single}
    if storage == ["binary_compressed"]:
        return _compressed(path, body, count, fields)
    if storage != ["binary"]:
        raise DataError(f"{path}: DATA: expected ascii, binary or binary_compressed, found {storage}")
    rows = _of_rows(path, body, count, kind)
    return {name: rows[name][:, 0] for name in single}


def _of_rows(path: Path, body: bytes, count: int, kind: np.dtype) -> dict[str, np.ndarray]:
    if not kind.itemsize or len(body) < count * kind.itemsize:
        raise DataError(
            f"{path}: expected {count} points of {kind.itemsize} bytes, found {len(body)} bytes; copy it"
        )
    rows = np.frombuffer(body, kind, count)
    return {name: rows[name] for name in kind.names or ()}


def _of_text(path: Path, body: bytes, count: int, kinds: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Columns of lines of text, each of its declared type."""
    # A number takes 8 bytes here; as Python's own, or as text, several times that.
    values, lines = array("d"), io.BytesIO(body)
    try:
        for _ in range(count):
            line = lines.readline(_LONGEST_LINE)
            words = line.split()
            if line and (len(words) != len(kinds) or len(line) == _LONGEST_LINE):
                raise ValueError(f"found {len(words)} in {line!r:.60}")
            values.extend(float(word) for word in words)
    except ValueError as error:
        raise DataError(f"{path}: expected {len(kinds)} numbers a line ({error})") from error
    rows = np.frombuffer(values).reshape(-1, len(kinds)) if values else np.zeros((0, len(kinds)))
    if len(rows) != count:
        raise DataError(f"{path}: expected {count} points, found {len(rows)}; copy it again")
    return {
        name: _of_type(path, name, rows[:, k], np.dtype(kind)) for k, (name, kind) in enumerate(kinds.items())
    }


def _of_type(path: Path, name: str, values: np.ndarray, kind: np.dtype) -> np.ndarray:
    if kind.kind == "f":
        with np.errstate(over="ignore"):
            return values.astype(kind)
    bounds = np.iinfo(kind)
    wrong = values[~((values >= bounds.min) & (values < bounds.max + 1))]
    if len(wrong):
        raise DataError(
            f"{path}: {name}: expected whole numbers {bounds.min} to {bounds.max} as its type says, found "
            f"{wrong[0]:g}; correct the header's type"
        )
    return values.astype(kind)


def _compressed(
    path: Path, body: bytes, count: int, fields: list[tuple[str, str, tuple[int]]]
) -> dict[str, np.ndarray]:
    """Columns of the storage `binary_compressed`: one field after the other, packed by LZF."""
    packed, whole = (int(one) for one in np.frombuffer(body[:8].ljust(8, b"\0"), "<u4"))
    expected = count * sum(np.dtype(kind).itemsize * n[0] for _, kind, n in fields)
    if expected > MOST_FILE_BYTES:
        raise DataError(
            f"{path}: expected at most {MOST_FILE_BYTES:,} bytes of points, found {expected:,} packed ones; "
            "leave out fields that are not needed"
        )
    if whole != expected or len(body) < 8 + packed:
        raise DataError(f"{path}: expected {expected} bytes of points, found {whole}; copy it again")
    data = _lzf(path, body[8 : 8 + packed], whole)
    found, position = {}, 0
    for name, kind, n in fields:
        size = count * np.dtype(kind).itemsize * n[0]
        if n == (1,):
            found[name] = np.frombuffer(data[position : position + size], kind)
        position += size
    return found


def _lzf(path: Path, packed: bytes, size: int) -> bytes:
    """Bytes of LZF's literal runs (control below 32) and back references."""
    out, k = bytearray(), 0
    try:
        while k < len(packed):
            control = packed[k]
            k += 1
            if control < 32:
                out += packed[k : k + control + 1]
                k += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[k]
                k += 1
            start = len(out) - ((control & 31) << 8) - packed[k] - 1
            k += 1
            if start < 0 or len(out) > size:
                raise IndexError
            # It may reach into what it makes: then it repeats itself.
            seen = out[start : start + length + 2]
            out += (seen * (length // len(seen) + 2))[: length + 2]
    except IndexError as error:
        raise DataError(f"{path}: its packed points are damaged; copy it again") from error
    if len(out) != size:
        raise DataError(f"{path}: expected {size} bytes of points, found {len(out)}; copy it again")
    return bytes(out)
