"""The random mutations: each is done and told, and however a case ends is known."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks.hostile.limits import End, run_limited
from benchmarks.hostile.mutations import _ANY, _KINDS, mutate
from benchmarks.hostile.table import counts, silent
from nvsf_core.errors import DataError


def _refused() -> End:
    raise DataError("expected this, found that; do so")


def _raw() -> End:
    raise KeyError("lost")


def _crashed() -> End:
    os.kill(os.getpid(), signal.SIGKILL)
    return End("harmless")


def _hung() -> End:
    time.sleep(60)
    return End("harmless")


def _greedy() -> End:
    np.ones(1 << 30)
    return End("harmless")


@pytest.mark.parametrize(
    ("case", "kind", "words"),
    [
        (lambda: End("doubted", "a check"), "doubted", "a check"),
        (_refused, "refused", "DataError: expected this"),
        (_raw, "raw error", "KeyError: 'lost' (test_hostile.py"),
        (_crashed, "crash", "signal 9"),
        (_hung, "hang", "more than"),
        (_greedy, "raw error", "MemoryError"),
    ],
)
def test_however_a_case_ends_is_told(case, kind, words):
    end = run_limited(case, seconds=1.0)
    assert end.kind == kind and words.split("Error")[0] in end.words


@pytest.mark.parametrize("suffix", [*_KINDS, ".parquet"])
def test_every_harm_can_be_done_to_every_file_of_its_kind(tmp_path: Path, suffix: str):
    for harm in set(_KINDS.get(suffix, ()) + _ANY):
        place = tmp_path / harm.__name__
        place.mkdir()
        for content in (b"", b"key: 1.5 2\nother: 3\n", bytes(range(256))):
            path = place / f"a{suffix}"
            if path.is_dir():
                path.rmdir()
            path.unlink(missing_ok=True)
            path.write_bytes(content)
            harm(path, np.random.default_rng(0))


def test_a_harm_is_named_and_the_same_seed_does_the_same(tmp_path: Path):
    made = []
    for name in ("one", "two"):
        path = tmp_path / name / "poses.txt"
        path.parent.mkdir()
        path.write_text("0 1 2 3\n1 2 3 4\n")
        made.append((mutate(path, np.random.default_rng(3)), path.read_bytes() if path.is_file() else None))
    assert made[0] == made[1] and made[0][0]


def test_the_table_counts_each_end_once():
    rows = [
        {"subject": "drive", "kind": kind, "harmed": "scan", "how": "flip"} for kind in ("refused", "silent")
    ]
    assert "| drive | 2 | 1 | 0 | 0 | 0 | 1 | 0 | 0 | 0 |" in counts(rows)
    assert "| scan | flip | 1 |" in silent(rows)
    assert silent(rows[:1]) == "Nothing was accepted silently.\n"
