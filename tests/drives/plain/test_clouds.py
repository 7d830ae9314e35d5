"""Points of plain files: each kind gives what was written, a cut file is refused."""

from pathlib import Path

import numpy as np
import pytest

from nvsf_core.clouds.ply import write_ply
from nvsf_core.drives.plain.clouds import read_bin, read_pcd, read_ply
from nvsf_core.errors import DataError

ROWS = np.array([[1.0, 2.0, 3.0, 0.5], [-4.0, 5.5, -6.25, 0.25], [7.0, -8.0, 9.0, 1.0]], np.float32)
NAMES = ("x", "y", "z", "intensity")
HEAD = "VERSION .7\nFIELDS x y z intensity ring _\nSIZE 4 4 4 4 2 1\nTYPE F F F F U U\nCOUNT 1 1 1 1 1 3\n"
PLACE = Path("scan")


def _pcd(data: str, body: bytes) -> bytes:
    return f"# .PCD\n{HEAD}WIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA {data}\n".encode() + body


def _rows() -> np.ndarray:
    rows = np.zeros(3, np.dtype([(name, "<f4") for name in NAMES] + [("ring", "<u2"), ("pad", "u1", (3,))]))
    for k, name in enumerate(NAMES):
        rows[name] = ROWS[:, k]
    rows["ring"] = [5, 6, 7]
    return rows


def _lzf(data: bytes) -> bytes:
    """Literal runs, and one reference back: the last 8 bytes repeat 8 before them."""
    head, runs = data[:-8], b""
    for k in range(0, len(head), 32):
        part = head[k : k + 32]
        runs += bytes([len(part) - 1]) + part
    offset = 8 - 1
    return runs + bytes([(6 << 5) | (offset >> 8), offset & 255])


def test_a_bin_is_rows_of_four_floats():
    found = read_bin(PLACE, ROWS.tobytes())
    assert np.array_equal(np.stack([found[name] for name in NAMES], axis=1), ROWS)
    with pytest.raises(DataError, match="rows of 16 bytes"):
        read_bin(PLACE, ROWS.tobytes()[:-1])


def test_a_ply_of_our_own_writer_is_read(tmp_path):
    write_ply(tmp_path / "a.ply", ROWS[:, :3], ROWS[:, 3])
    found = read_ply(PLACE, (tmp_path / "a.ply").read_bytes())
    assert np.array_equal(np.stack([found[name] for name in NAMES], axis=1), ROWS)


def test_a_ply_of_text_with_rings_and_faces_is_read():
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty double y\nproperty float z\n"
    text = (
        head
        + "property uchar ring\nelement face 0\nproperty list uchar int v\nend_header\n1 2 3 9\n4 5 6 8\n"
    )
    found = read_ply(PLACE, text.encode())
    assert found["ring"].tolist() == [9, 8] and found["y"].tolist() == [2, 5]


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_each_storage_of_a_pcd_gives_the_same(kind):
    rows = _rows()
    if kind == "ascii":
        lines = [" ".join(map(str, [*ROWS[k].tolist(), 5 + k, 0, 0, 0])) for k in range(3)]
        data = _pcd(kind, "\n".join(lines).encode())
    elif kind == "binary":
        data = _pcd(kind, rows.tobytes())
    else:
        columns = b"".join(rows[name].tobytes() for name in rows.dtype.names)
        columns = columns[:-9] + b"\0" * 9
        packed = _lzf(columns)
        data = _pcd(kind, np.array([len(packed), len(columns)], "<u4").tobytes() + packed)
    found = read_pcd(PLACE, data)
    assert np.array_equal(np.stack([found[name] for name in NAMES], axis=1).astype(np.float32), ROWS)
    assert found["ring"].tolist() == [5, 6, 7]


def test_columns_of_text_have_the_types_that_the_header_says():
    head = "FIELDS x t\nSIZE 4 4\nTYPE F U\nWIDTH 2\nHEIGHT 1\nDATA ascii\n"
    found = read_pcd(PLACE, f"{head}1.5 7\nnan 99000000\n".encode())
    assert found["x"].dtype == np.float32 and found["t"].dtype == np.uint32
    assert found["t"].tolist() == [7, 99_000_000]
    for wrong in ("-1", "4294967296", "nan"):
        with pytest.raises(DataError, match="scan: t: expected whole numbers 0 to 4294967295"):
            read_pcd(PLACE, f"{head}1 7\n2 {wrong}\n".encode())
    ply = "ply\nformat ascii 1.0\nelement vertex 1\nproperty double x\nproperty uint t\nend_header\n1 8\n"
    assert read_ply(PLACE, ply.encode())["t"].dtype == np.uint32


@pytest.mark.parametrize(
    ("read", "data"),
    [
        (
            read_ply,
            b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nend_header\nab",
        ),
        (read_ply, b"not a ply"),
        (read_ply, b"ply\nformat ascii 1.0\nelement vertex " + b"9" * 5000 + b"\nend_header\n"),
        (read_pcd, _pcd("binary", b"short")),
        (read_pcd, _pcd("binary_compressed", b"\x01\0\0\0\x45\0\0\0\xff")),
        (read_pcd, b"FIELDS x\n"),
    ],
)
def test_a_damaged_file_is_refused_by_name(read, data):
    with pytest.raises(DataError, match="scan: "):
        read(PLACE, data)


def test_a_point_without_numbers_or_with_millions_of_them_is_refused():
    empty = b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nend_header\n"
    with pytest.raises(DataError, match="expected"):
        read_ply(PLACE, empty)
    for data in ("ascii", "binary", "binary_compressed"):
        wide = _pcd(data, b"1 2 3\n").replace(b"COUNT 1 1 1 1 1 3", b"COUNT 1 1 1 1 1 500000000")
        with pytest.raises(DataError, match="expected 1 to 256 bytes a point"):
            read_pcd(PLACE, wide)


def test_a_packed_pcd_becomes_no_more_than_a_file_may_have():
    head = (
        "FIELDS x y z e\nSIZE 4 4 4 8\nTYPE F F F F\nCOUNT 1 1 1 29\nPOINTS 4000000\nDATA binary_compressed\n"
    )
    size = 4_000_000 * 244
    packed = b"\x00\x00" + b"\xe0\xff\x00" * (size // 264)
    data = head.encode() + np.array([len(packed), size], "<u4").tobytes() + packed
    with pytest.raises(DataError, match="expected at most 268,435,456 bytes of points, found 976,000,000"):
        read_pcd(PLACE, data)


@pytest.mark.parametrize("offset", [1, 3, 8, 40])
def test_a_reference_into_what_it_makes_repeats_it(offset):
    """LZF's own rule: byte by byte, each from `offset` bytes before."""
    start = bytes(range(1, 33)) + bytes(range(101, 117))
    whole = bytearray(start)
    for _ in range(24):
        whole.append(whole[-offset])
    packed = b"\x1f" + start[:32] + b"\x0f" + start[32:] + bytes([7 << 5, 24 - 9, offset - 1])
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE U U U\nPOINTS 6\nDATA binary_compressed\n"
    data = head.encode() + np.array([len(packed), len(whole)], "<u4").tobytes() + packed
    found = read_pcd(PLACE, data)
    assert b"".join(found[name].tobytes() for name in "xyz") == bytes(whole)
