from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.kitti360.scans import Scan, parse_scan, read_scan_bytes
from nvsf_core.errors import DataError
from nvsf_core.sensors.tables import SENSOR_TABLES


def written(path: Path, points: np.ndarray) -> Path:
    points.astype("<f4").tofile(path)
    return path


def load_scan(path: Path) -> Scan:
    return parse_scan(path, read_scan_bytes(path))


def plausible(n: int = 1000) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-60, 60, (n, 3)), rng.uniform(0, 1, n)]).astype(np.float32)


def test_a_good_scan_comes_back_bit_for_bit_in_file_order(tmp_path: Path) -> None:
    points = plausible()
    found = load_scan(written(tmp_path / "a.bin", points)).points
    assert found.dtype == np.float32 and np.array_equal(found, points)


@pytest.mark.parametrize(
    "garbage",
    [[np.nan, 0, 0, 0.5], [np.inf, 0, 0, 0.5], [301, 0, 0, 0.5], [1, 1, 1, 77.0], [3e38, 3e38, 3e38, 0]],
)
def test_few_absurd_returns_are_dropped_and_counted(tmp_path: Path, garbage: list[float]) -> None:
    points = plausible()
    points[[3, 500]] = garbage
    scan = load_scan(written(tmp_path / "a.bin", points))
    assert scan.n_absurd == 2
    assert np.array_equal(scan.points, np.delete(points, [3, 500], axis=0))


def test_more_than_one_percent_of_absurd_returns_spoil_the_scan(tmp_path: Path) -> None:
    points = plausible()
    points[:10, 0] = 500.0
    assert load_scan(written(tmp_path / "ten.bin", points)).n_absurd == 10
    points[10, 0] = np.nan
    with pytest.raises(DataError, match=r"11 of 1000 returns are absurd \(1 not finite, 10 beyond 300 m"):
        load_scan(written(tmp_path / "eleven.bin", points))


@pytest.mark.parametrize(
    ("scale", "remedy"),
    [
        ([1e3, 1e3, 1e3, 1], "; give points in metres, in the sensor's own frame, or copy it again where it"),
        ([1, 1, 1, 255], "; scale intensities to 0..1, or copy it again where it is damaged"),
        ([np.nan, 1, 1, 1], "; copy it again where it is damaged"),
    ],
)
def test_a_scan_of_absurd_returns_is_refused_with_what_mends_it(
    tmp_path: Path, scale: list[float], remedy: str
) -> None:
    with pytest.raises(DataError) as refused:
        load_scan(written(tmp_path / "a.bin", plausible() * np.float32(scale)))
    assert remedy in str(refused.value)


@pytest.mark.parametrize("sensor", SENSOR_TABLES)
def test_returns_as_far_as_a_known_lidar_sees_are_usable(tmp_path: Path, sensor: str) -> None:
    points = plausible()
    points[:100, :3] = SENSOR_TABLES[sensor].max_range_m, 0.0, 0.0
    assert load_scan(written(tmp_path / "a.bin", points)).n_absurd == 0


def test_rays_written_without_an_answer_do_not_spoil_the_scan(tmp_path: Path) -> None:
    points = plausible()
    points[:300] = 0.0
    scan = load_scan(written(tmp_path / "a.bin", points))
    assert (scan.n_absurd, len(scan.points)) == (0, 700)


def test_a_truncated_scan_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.bin", plausible())
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(DataError, match=r"a\.bin: truncated scan, 15995 bytes"):
        load_scan(path)


def test_an_empty_or_absent_scan_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.bin").touch()
    with pytest.raises(DataError, match="no returns"):
        load_scan(tmp_path / "a.bin")
    with pytest.raises(DataError, match="no scan file"):
        load_scan(tmp_path / "b.bin")
