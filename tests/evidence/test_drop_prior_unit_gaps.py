"""Laws of the recorded unit's gaps: what never returns wherever it drives, though there are surfaces."""

import numpy as np

from nvsf_core.evidence.drop_prior import GAP_CELLS, DropPrior, cells_of, find_unit_gaps, places_apart

SCANS, LASERS = 8, 3
FRACTION = ((np.arange(GAP_CELLS, dtype=np.float32) + 0.5) / GAP_CELLS - 0.5).astype(np.float32)


def prior_of(is_hit: np.ndarray) -> DropPrior:
    return DropPrior(np.arange(float(SCANS)), np.tile(FRACTION, (SCANS, 1)), is_hit)


def test_a_firing_that_never_returns_is_a_gap_with_its_blurred_ends() -> None:
    is_hit = np.ones((SCANS, LASERS, GAP_CELLS), bool)
    is_hit[:, 1, 500:520] = False
    is_hit[:6, 1, 520:522] = False
    gaps = find_unit_gaps(prior_of(is_hit), np.arange(SCANS), np.ones_like(is_hit))
    assert gaps is not None
    assert np.argwhere(gaps).tolist() == [[1, cell] for cell in range(500, 522)]


def test_what_moves_past_is_no_gap() -> None:
    is_hit = np.ones((SCANS, LASERS, GAP_CELLS), bool)
    for scan in range(SCANS):
        is_hit[scan, :, 100 * scan : 100 * scan + 40] = False
    gaps = find_unit_gaps(prior_of(is_hit), np.arange(SCANS), np.ones_like(is_hit))
    assert gaps is not None
    assert not gaps.any()


def test_the_sky_is_no_gap() -> None:
    is_hit = np.ones((SCANS, LASERS, GAP_CELLS), bool)
    is_hit[:, 0] = False
    is_met = np.ones_like(is_hit)
    is_met[:, 0] = False
    gaps = find_unit_gaps(prior_of(is_hit), np.arange(SCANS), is_met)
    assert gaps is not None
    assert not gaps.any()


def test_a_drive_that_stands_tells_no_gaps() -> None:
    is_hit = np.zeros((SCANS, LASERS, GAP_CELLS), bool)
    scans = places_apart(np.zeros((SCANS, 3)), 12)
    assert scans.tolist() == [0]
    assert find_unit_gaps(prior_of(is_hit), scans, np.ones_like(is_hit[scans])) is None


def test_places_are_a_metre_apart_and_evenly_spread() -> None:
    position_m = np.stack([np.arange(0.0, 20.0, 0.4), np.zeros(50), np.zeros(50)], axis=1)
    scans = places_apart(position_m, 5)
    assert len(scans) == 5
    assert np.diff(position_m[scans, 0]).min() >= 1.0
    assert (scans[0], scans[-1]) == (0, 48)


def test_each_firing_lies_in_its_own_cell() -> None:
    assert cells_of(FRACTION, GAP_CELLS).tolist() == list(range(GAP_CELLS))
    assert cells_of(np.array([-0.5, 0.5]), GAP_CELLS).tolist() == [0, GAP_CELLS - 1]
