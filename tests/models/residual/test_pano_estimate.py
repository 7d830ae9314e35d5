"""Laws of the pano that is expected over the firings' phases."""

import numpy as np

from nvsf_core.models.residual.pano_estimate import QUANTILES, PanoRays, combine_phases, estimate_pano
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.sensors.sweep import SweepRays, Trajectory, sweep_rays
from nvsf_core.sensors.tables import HDL_64E
from nvsf_core.simulation.scan import RenderedSweep

SMALL = LinearPano(height=3, width=5)
PANO = LinearPano(reference_quirks=True)
FIRINGS = 300
STILL = Trajectory(np.arange(3) * 0.1, np.tile(np.eye(4), (3, 1, 1)), np.eye(4))


def some_phases(seed: int) -> list[PanoRays]:
    rng = np.random.default_rng(seed)
    return [
        PanoRays(rng.integers(0, 14, n), rng.uniform(2, 60, n), rng.uniform(0, 1, n), rng.uniform(0, 1, n))
        for n in (40, 31, 0)
    ]


def shown_by(rays: PanoRays, cell: int) -> list[tuple[float, float, float]]:
    """Range, intensity, probability of what one phase's cell shows: the definition, ray by ray."""
    left, found = 1.0, []
    for k in sorted(np.flatnonzero(rays.cell == cell), key=lambda k: rays.range_m[k]):
        found.append((rays.range_m[k], rays.intensity[k], left * rays.hit[k]))
        left *= 1.0 - rays.hit[k]
    return found


def test_phases_combine_as_the_definition_says() -> None:
    phases = some_phases(0)
    estimate = combine_phases(phases, SMALL)
    for cell in range(15):
        place = np.unravel_index(cell, (3, 5))
        shown = sorted(one for rays in phases for one in shown_by(rays, cell))
        missed = [np.prod([1.0 - p for p in rays.hit[rays.cell == cell]]) for rays in phases]
        assert abs(estimate.hit[place] - np.mean([1.0 - m for m in missed])) < 1e-6
        assert abs(estimate.rays[place] - sum((r.cell == cell).sum() for r in phases) / 3) < 1e-6
        total = sum(p for _, _, p in shown)
        if not shown:
            assert not estimate.range_m[:, *place].any() and estimate.intensity[place] == 0.0
            continue
        assert abs(estimate.intensity[place] - sum(i * p for _, i, p in shown) / total) < 1e-6
        below = np.cumsum([p for _, _, p in shown]) / total
        expected = [shown[int(np.argmax(below >= q - 1e-12))][0] for q in QUANTILES]
        assert np.allclose(estimate.range_m[:, *place], expected, atol=1e-5)


def test_the_order_of_phases_and_of_their_rays_does_not_matter() -> None:
    phases = some_phases(1)
    names = ("cell", "range_m", "hit", "intensity")
    turned = [PanoRays(*(getattr(rays, name)[::-1] for name in names)) for rays in phases[::-1]]
    first, second = combine_phases(phases, SMALL), combine_phases(turned, SMALL)
    for name in ("hit", "range_m", "intensity", "rays"):
        assert np.allclose(getattr(first, name), getattr(second, name), atol=1e-6)


def test_the_same_phase_twice_is_that_phase() -> None:
    phases = some_phases(2)[:1]
    once, twice = combine_phases(phases, SMALL), combine_phases(phases * 2, SMALL)
    for name in ("hit", "range_m", "intensity", "rays"):
        assert np.allclose(getattr(once, name), getattr(twice, name), atol=1e-6)


def test_one_certain_turn_is_the_projection_of_its_scan() -> None:
    rays, rendered = fired(0.5)
    estimate = estimate_pano(lambda _: (rays, rendered), PANO, 1)
    points, intensity, _ = RenderedSweep.of(rays, rendered).scan()
    range_m, bright = PANO.project(points, intensity)
    # A scan's points are float32: a few lie on the border between two cells.
    assert np.mean((estimate.hit > 0.5) != (range_m > 0)) < 1e-3
    assert np.mean(np.abs(estimate.median_m - range_m) > 1e-3) < 1e-3
    assert np.mean(np.abs(estimate.intensity - bright) > 1e-3) < 1e-3
    assert (range_m > 0).sum() > 2000


def test_many_phases_make_a_fence_as_likely_as_it_is_wide() -> None:
    one = estimate_pano(fired, PANO, 1)
    parted = estimate_pano(fired, PANO, 2, parts=4)
    many = estimate_pano(fired, PANO, 8)
    rows = many.rays.sum(axis=1) > 0
    covered = FIRINGS / PANO.width
    assert set(np.unique(one.hit.round(3))) <= {0.0, 1.0}
    for estimate in (parted, many):
        assert ((estimate.hit >= 0.0) & (estimate.hit <= 1.0)).all()
        assert abs(estimate.hit[rows].mean() - one.hit[rows].mean()) < 0.03 * covered
    assert np.abs(parted.hit - many.hit).mean() < 0.2 * np.abs(one.hit - many.hit).mean()


def fired(phase: float) -> tuple[SweepRays, RenderedRays]:
    """A sensor of 300 firings a turn that stands; rays return, from 10 to 20 m, in every other sixth part."""
    rays = sweep_rays(HDL_64E, np.arange(64), FIRINGS, STILL, 0.1, 0.1, phase=phase)
    part = np.floor(rays.azimuth_rad / (np.pi / 6)).astype(int)
    hit = (part % 2 == 0).astype(np.float32)
    range_m = (15.0 + 5.0 * np.sin(rays.azimuth_rad)).astype(np.float32)
    return rays, RenderedRays(range_m, hit, np.full(len(hit), 0.3, np.float32))
