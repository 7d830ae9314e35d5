"""Laws of correcting hits in the sensor's own grid."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nvsf_core.errors import ShapeError
from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.fields.layers import CellNetwork
from nvsf_core.models.residual.raydrop_grid import FEATURES, SweepRaydrop, sweep_cells
from nvsf_core.recipe.residual import HitsSpec, TrainingSpec
from nvsf_core.recording.drive import RecordedSweeps, ScanLookups
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.sweep import SweepRays, Trajectory, sweep_rays
from nvsf_core.sensors.tables import HDL_64E
from nvsf_core.simulation.raydrop import EVEN, HitBlend

LASERS, FIRINGS, SCANS, PERIOD_S = np.arange(0, 64, 4), 300, 3, 0.1
SPEC = HitsSpec(channels=8, layers=1, training=TrainingSpec(steps=1, rays=1))
NEAR = np.array([1, 0, 2])


def scene() -> tuple[ScanLookups, SweepRays, RenderedRays]:
    rng = np.random.default_rng(1)
    path = Trajectory(np.arange(SCANS) * PERIOD_S, np.tile(np.eye(4), (SCANS, 1, 1)), np.eye(4))
    rays = sweep_rays(HDL_64E, LASERS, FIRINGS, path, PERIOD_S, PERIOD_S)
    hit_grid = rng.uniform(size=(SCANS, 64, FIRINGS)) < 0.8
    ranges = np.where(hit_grid, 10.0, 0.0).astype(np.float32)
    fraction = np.tile(rays.fraction[:FIRINGS].astype(np.float32), (SCANS, 1))
    scan_grids = RecordedSweeps(
        DropPrior(path.times_s, fraction, hit_grid), LASERS, ranges, 0.3 * hit_grid.astype(np.float32),
        path, HDL_64E, PERIOD_S, HDL_64E.elevation_correction_rad,
    )  # fmt: skip
    count = len(rays.laser)
    range_m = np.where(rng.uniform(size=count) < 0.9, 10.0, np.inf).astype(np.float32)
    hit, shine, hit_prior = rng.uniform(size=(3, count)).astype(np.float32)
    rendered = RenderedRays(range_m, np.where(np.isfinite(range_m), hit, 0.0), shine, hit_prior)
    return ScanLookups(scan_grids, NEAR), rays, rendered


def logit(share: np.ndarray, limit: float) -> np.ndarray:
    inside = np.clip(share.astype(np.float64), limit, 1.0 - limit)
    return np.log(inside / (1.0 - inside))


def test_an_untrained_network_leaves_the_mean_of_vote_and_ray_head() -> None:
    lookups, rays, rendered = scene()
    network = CellNetwork(FEATURES, 1, SPEC, torch.Generator().manual_seed(0))
    corrected = SweepRaydrop(network, EVEN)(rays, rendered, lookups)
    assert rendered.hit_prior is not None
    answered = np.isfinite(rendered.range_m)
    mean = 0.5 * logit(rendered.hit_prior, 0.02) + 0.5 * logit(rendered.hit, 0.003)
    assert np.allclose(logit(corrected.hit, 1e-6)[answered], mean[answered], atol=1e-3)
    assert not corrected.hit[~answered].any(), "what nothing answers stays dropped"
    assert np.array_equal(corrected.range_m, rendered.range_m)
    assert np.array_equal(corrected.intensity, rendered.intensity)


def test_a_correction_comes_back_to_the_ray_that_it_was_made_for() -> None:
    lookups, rays, rendered = scene()
    network = CellNetwork(FEATURES, 1, replace(SPEC, layers=0), torch.Generator().manual_seed(0))
    with torch.no_grad():
        # Logit += 3 x the expected intensity of the cell itself, which is the last feature but one.
        network.layers[0].weight[0, -2, 1, 1] = 3.0  # type: ignore[index]
    found = SweepRaydrop(network, HitBlend(network=1.0, ray_head=0.0, offset=0.0))(rays, rendered, lookups)
    assert rendered.hit_prior is not None
    answered = np.isfinite(rendered.range_m)
    expected = logit(rendered.hit_prior, 0.02) + 3.0 * rendered.intensity
    assert np.allclose(logit(found.hit, 1e-9)[answered], expected[answered], atol=1e-2)


def test_what_ends_on_a_moving_object_keeps_its_own_hit_probability() -> None:
    lookups, rays, rendered = scene()
    on_object = np.arange(len(rays.laser)) % 3 == 0
    network = CellNetwork(FEATURES, 1, SPEC, torch.Generator().manual_seed(0))
    corrected = SweepRaydrop(network, EVEN)(rays, replace(rendered, on_object=on_object), lookups)
    everywhere = SweepRaydrop(network, EVEN)(rays, rendered, lookups)
    assert np.array_equal(corrected.hit[on_object], rendered.hit[on_object])
    assert np.array_equal(corrected.hit[~on_object], everywhere.hit[~on_object])
    assert (everywhere.hit != rendered.hit)[on_object].any(), "elsewhere it would have been corrected"


def test_one_column_is_one_azimuth_and_each_firing_is_told_once() -> None:
    lookups, rays, rendered = scene()
    column = sweep_cells(rays, rendered, lookups).column.numpy()
    assert np.array_equal(np.sort(column, axis=1), np.tile(np.arange(FIRINGS), (len(LASERS), 1)))
    azimuth = np.take_along_axis(rays.azimuth_rad.reshape(rays.shape), column, axis=1)
    apart = np.angle(np.exp(1j * (azimuth - azimuth[:1])))
    assert np.abs(apart).max() <= 2.0 * np.pi / FIRINGS


def test_what_is_told_is_moderate_and_nothing_of_the_ray_heads_hits() -> None:
    lookups, rays, rendered = scene()
    cells = sweep_cells(rays, rendered, lookups)
    assert torch.isfinite(cells.features).all() and cells.features.abs().max() < 3.0
    other = sweep_cells(rays, replace(rendered, hit=1.0 - rendered.hit), lookups)
    assert torch.equal(cells.features, other.features) and torch.equal(cells.prior_logit, other.prior_logit)


def test_answers_without_votes_are_refused() -> None:
    lookups, rays, rendered = scene()
    with pytest.raises(ShapeError, match="expected rays with hit priors"):
        sweep_cells(rays, replace(rendered, hit_prior=None), lookups)
