"""Clusters of one object are linked from scan to scan, at the speeds that cars drive."""

import numpy as np
import pytest

from nvsf_core.evidence.moving.detection import Cluster, link_tracks

SCANS = 12


def cluster(scan: int, period_s: float, x_m: float, y_m: float = 0.0, size_m: float = 4.5) -> Cluster:
    return Cluster(
        scan=scan, members=np.arange(200), time_s=scan * period_s, centre_m=np.array([x_m, y_m, 0.8]),
        size_m=size_m, nearest_m=12.0,
    )  # fmt: skip


@pytest.mark.parametrize("period_s", [0.1, 0.2])
@pytest.mark.parametrize("speed_km_h", [5.0, 30.0, 55.0, 80.0, 120.0, 150.0])
def test_a_car_is_one_track_at_any_speed(speed_km_h: float, period_s: float) -> None:
    step_m = speed_km_h / 3.6 * period_s
    (track,) = link_tracks([[cluster(k, period_s, step_m * k)] for k in range(SCANS)], period_s)
    assert [one.scan for one in track.clusters] == list(range(SCANS))


def test_cars_that_follow_each_other_are_told_apart() -> None:
    step_m, apart_m = 2.5, 12.0
    scans = [[cluster(k, 0.1, step_m * k), cluster(k, 0.1, step_m * k + apart_m)] for k in range(SCANS)]
    tracks = link_tracks(scans, 0.1)
    assert sorted(len(track.clusters) for track in tracks) == [SCANS, SCANS]
    assert all(np.ptp(np.diff(track.centres_m()[:, 0])) < 1e-9 for track in tracks)


def test_a_step_that_nothing_goes_on_with_is_no_motion() -> None:
    # Leaves flicker at random places, alike in size.
    places = np.random.default_rng(0).uniform(-4.0, 4.0, (SCANS, 2))
    places[::2] += 40.0
    scans = [[cluster(k, 0.1, *place, size_m=1.0)] for k, place in enumerate(places)]
    assert link_tracks(scans, 0.1) == []


def test_a_slow_object_keeps_its_scan_beside_a_fast_steps_offer() -> None:
    # Something unlike anything else was seen once, three metres beside a pedestrian's path.
    scans = [[cluster(k, 0.1, 0.15 * k, size_m=1.0)] for k in range(SCANS)]
    scans[3].append(cluster(3, 0.1, 0.6, 3.0, size_m=1.0))
    (track,) = link_tracks(scans, 0.1)
    assert len(track.clusters) == SCANS and abs(track.centres_m()[:, 1]).max() == 0.0


def test_a_car_is_one_track_where_every_fourth_scan_is_for_training() -> None:
    scans = [[cluster(k, 0.4, 4.0 * k)] for k in range(SCANS)]
    (track,) = link_tracks(scans, 0.1, scan_step_s=0.4)
    assert len(track.clusters) == SCANS


def test_a_car_that_brakes_hard_is_one_track_at_two_scans_a_second() -> None:
    time_s = 0.5 * np.arange(8)
    x_m = 14.0 * time_s - 0.5 * 3.5 * time_s**2
    (track,) = link_tracks([[cluster(k, 0.5, one)] for k, one in enumerate(x_m)], 0.5)
    assert len(track.clusters) == len(time_s)
