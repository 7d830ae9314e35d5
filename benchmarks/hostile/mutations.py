"""Random damage to a file: to its bytes, its text, its numbers, or to the file as a whole."""

import os
import re
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Random = np.random.Generator
ODD_NUMBERS = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e-308", "5e-324", "0", "-0.0", "-1", "1", "1e12", "9e99",
    "1e400", "2147483648", "18446744073709551616", "0.5", "1e-9", "1_000", "\u0663", "", "abc", "0x10",
    "1" * 400, "--3", "1e", "NaN", "None",
)  # fmt: skip
MOST_BYTES = 16 << 20
"""Larger files, sparse ones of before, are harmed no further: who harms reads them whole."""
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_]{3,}")


def one_of(items: Sequence[Any], random: Random) -> Any:
    """Any of them."""
    return items[int(random.integers(len(items)))]


def mutate(path: Path, random: Random) -> str:
    """Do one thing to a file; returns what, in words."""
    if path.stat().st_size > MOST_BYTES:
        return "nothing more"  # a sparse file of before
    harm = one_of(_KINDS.get(path.suffix, ()) + _ANY, random)
    harm(path, random)
    return harm.__name__.strip("_").replace("_", " ")


def _flip(path: Path, random: Random) -> None:
    content = bytearray(path.read_bytes())
    for _ in range(int(random.integers(1, 9)) if content else 0):
        content[int(random.integers(len(content)))] ^= 1 << int(random.integers(8))
    path.write_bytes(bytes(content))


def _cut(path: Path, random: Random) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(random.integers(len(content) + 1))])


def _append_noise(path: Path, random: Random) -> None:
    path.write_bytes(path.read_bytes() + random.bytes(int(random.integers(1, 4000))))


def _repeat(path: Path, random: Random) -> None:
    path.write_bytes(path.read_bytes() * int(random.integers(2, 5)))


def _zero_a_part(path: Path, random: Random) -> None:
    content = bytearray(path.read_bytes())
    start = int(random.integers(len(content) + 1))
    length = int(random.integers(1, 400))
    content[start : start + length] = bytes(len(content[start : start + length]))
    path.write_bytes(bytes(content))


def _remove(path: Path, random: Random) -> None:
    path.unlink()


def _folder(path: Path, random: Random) -> None:
    path.unlink()
    path.mkdir()


def _pipe(path: Path, random: Random) -> None:
    path.unlink()
    os.mkfifo(path)


def _endless(path: Path, random: Random) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def _circle(path: Path, random: Random) -> None:
    path.unlink()
    path.symlink_to(path)


def _sparse(path: Path, random: Random) -> None:
    with path.open("r+b") as handle:
        handle.truncate(int(random.integers(1, 30)) << 30)


def _other_file(path: Path, random: Random) -> None:
    near = sorted(other for other in path.parent.parent.rglob("*") if other.is_file() and other != path)
    others = [other for other in near if other.stat().st_size <= MOST_BYTES]
    path.write_bytes(one_of(others, random).read_bytes() if others else b"")


def _odd_number(path: Path, random: Random) -> None:
    _replace_one(path, random, _NUMBER, lambda _: one_of(ODD_NUMBERS, random).encode())


def _scaled_number(path: Path, random: Random) -> None:
    def scaled(number: bytes) -> bytes:
        return f"{float(number) * 10.0 ** float(random.integers(-12, 13)):.17g}".encode()

    _replace_one(path, random, _NUMBER, scaled)


def _misspelt_word(path: Path, random: Random) -> None:
    _replace_one(path, random, _WORD, lambda word: word[:-1])


def _replace_one(path: Path, random: Random, what: re.Pattern[bytes], by: Callable[[bytes], bytes]) -> None:
    """One match of a pattern, by something made of it."""
    content = path.read_bytes()
    found = list(what.finditer(content))
    if found:
        match = one_of(found, random)
        path.write_bytes(content[: match.start()] + by(match[0]) + content[match.end() :])


def _line(path: Path, random: Random) -> None:
    """A line gone, twice, swapped with the next, or garbled."""
    lines = path.read_bytes().split(b"\n")
    at = int(random.integers(len(lines)))
    kind = int(random.integers(4))
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(at, lines[at])
    elif kind == 2:
        lines[at : at + 2] = lines[at : at + 2][::-1]
    else:
        lines[at] = random.bytes(20)
    path.write_bytes(b"\n".join(lines))


def _many_lines(path: Path, random: Random) -> None:
    path.write_bytes(path.read_bytes() + b"1: 2 3\n" * int(random.integers(1, 300_000)))


def _other_text(path: Path, random: Random) -> None:
    texts = (b"{}", b"[]", b"null", b'"a"', b"[" * 20_000, b"\xef\xbb\xbf", b"\xff\xfe", b"\0" * 50, b"\n")
    text = one_of(texts, random)
    path.write_bytes(text if random.random() < 0.5 else text + path.read_bytes())


def _scan_numbers(path: Path, random: Random) -> None:
    rows = _scan(path)
    odd = np.float32([np.nan, np.inf, 0, -1, 1e-30, 3e38, 250, 77, 1e-3, 0.5])
    count = int(10 ** random.uniform(0, 3))
    at = (random.integers(len(rows), size=count), random.integers(4, size=count))
    rows[at] = random.choice(odd, size=count if random.random() < 0.5 else 1)
    rows.tofile(path)


def _scan_rows(path: Path, random: Random) -> None:
    """Rows shuffled, all the same, few, or many times over."""
    rows = _scan(path)
    kind, again = int(random.integers(4)), np.tile(rows, (50, 1))
    (random.permutation(rows), np.repeat(rows[:1], len(rows), axis=0), rows[:3], again)[kind].tofile(path)


def _scan_moved(path: Path, random: Random) -> None:
    """Scaled, mirrored, turned upside down, or shifted as a whole."""
    rows = _scan(path)
    kind = int(random.integers(3))
    if kind == 0:
        rows[:, :3] *= np.float32(10.0 ** random.uniform(-6, 3))
    elif kind == 1:
        rows[:, int(random.integers(3))] *= -1
    else:
        rows[:, :3] += random.normal(0, 10, 3).astype(np.float32)
    rows.tofile(path)


def _scan(path: Path) -> np.ndarray:
    content = path.read_bytes()
    return np.frombuffer(content[: len(content) // 16 * 16] or bytes(16), "<f4").reshape(-1, 4).copy()


def _png_header(path: Path, random: Random) -> None:
    """Size, depth, colour type or interlacing that are not the image's, with a right checksum."""
    header = bytearray(path.read_bytes()[16:29])
    if len(header) == 13:
        at = int(random.integers(5))
        if at < 2:
            side = int(random.choice([0, 1, 63, 65, 20_000, 2**31 - 1]))
            header[4 * at : 4 * at + 4] = struct.pack(">I", side)
        else:
            place = {2: 8, 3: 9, 4: 12}[at]
            header[place] = int(random.choice([0, 1, 2, 3, 4, 6, 7, 16]))
        _with_chunk(path, bytes(header), [])


def _png_chunk(path: Path, random: Random) -> None:
    """One more chunk: EXIF, a text that unpacks to a gigabyte, a palette, noise."""
    bomb = b"a\0\0" + zlib.compress(bytes(1 << 20)) if random.random() < 0.5 else random.bytes(50)
    name = random.choice([b"eXIf", b"zTXt", b"iCCP", b"PLTE", b"tRNS", b"gAMA", b"acTL", b"IDAT", b"abCd"])
    _with_chunk(path, path.read_bytes()[16:29], [(bytes(name), bomb)])


def _png_pixels(path: Path, random: Random) -> None:
    """Rows that are too few, too many, or noise, well packed."""
    rows = bytes(int(random.integers(1, 20_000))) if random.random() < 0.7 else random.bytes(500)
    packed = zlib.compress(rows) if random.random() < 0.7 else rows
    content = path.read_bytes()
    path.write_bytes(content[:33] + _chunk(b"IDAT", packed) + _chunk(b"IEND", b""))


def _with_chunk(path: Path, header: bytes, more: list[tuple[bytes, bytes]]) -> None:
    content = path.read_bytes()
    made = b"".join(_chunk(name, body) for name, body in more)
    path.write_bytes(content[:8] + _chunk(b"IHDR", header) + made + content[33:])


def _chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


Harm = Callable[[Path, Random], None]
_ANY: tuple[Harm, ...] = (
    _flip, _cut, _append_noise, _repeat, _zero_a_part, _remove, _folder, _pipe, _endless, _circle, _sparse,
    _other_file,
)  # fmt: skip
_TEXT: tuple[Harm, ...] = (_odd_number, _scaled_number, _misspelt_word, _line, _many_lines, _other_text) * 2
_KINDS: dict[str, tuple[Harm, ...]] = {
    ".txt": _TEXT, ".yaml": _TEXT, ".xml": _TEXT, ".toml": _TEXT, ".json": _TEXT,
    ".bin": (_scan_numbers, _scan_rows, _scan_moved) * 3,
    ".png": (_png_header, _png_chunk, _png_pixels) * 3,
}  # fmt: skip
