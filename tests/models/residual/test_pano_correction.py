"""Laws of correcting an expected pano: parts are corrected one by one, and an untrained network is silent."""

import numpy as np
import pytest
import torch

from nvsf_core.fields.layers import CellNetwork
from nvsf_core.models.residual.pano_estimate import PanoEstimate
from nvsf_core.models.residual.pano_neighbours import (
    FEATURES,
    PARTS,
    Neighbours,
    cell_features,
    corrected_pano,
    phases_alone,
)
from nvsf_core.recipe.residual import PanoSpec

SHAPE = (6, 20)
IMAGES = {"range": 0, "intensity": 1, "hit": 2}


def expected() -> tuple[PanoEstimate, Neighbours]:
    rng = np.random.default_rng(0)
    hit = rng.uniform(0, 1, SHAPE).astype(np.float32)
    hit[:, :4] = 0.0
    hit[:, 4:6] = 1.0
    shown = hit > 0
    ranges = np.sort(rng.uniform(2, 60, (3, *SHAPE)), axis=0).astype(np.float32) * shown
    intensity = rng.uniform(0, 1, SHAPE).astype(np.float32) * shown
    estimate = PanoEstimate(hit=hit, range_m=ranges, intensity=intensity, rays=shown * np.float32(2.0))
    return estimate, Neighbours(*(rng.uniform(0, 1, (6, *SHAPE)).astype(np.float32)))


def network(*, learned: bool) -> CellNetwork:
    made = CellNetwork(FEATURES, len(PARTS), PanoSpec(), torch.Generator().manual_seed(0))
    if learned:
        with torch.no_grad():
            made.layers[-1].weight.normal_(std=9.0, generator=torch.Generator().manual_seed(6))
    return made


def test_an_untrained_network_shows_the_phases() -> None:
    estimate, neighbours = expected()
    for found, alone in zip(
        corrected_pano(network(learned=False), estimate, neighbours), phases_alone(estimate), strict=True
    ):
        assert np.abs(found - alone).max() < 0.011


@pytest.mark.parametrize("part", PARTS)
def test_a_part_is_corrected_by_itself(part: str) -> None:
    estimate, neighbours = expected()
    found = corrected_pano(network(learned=True), estimate, neighbours, (part,))
    for name, number in IMAGES.items():
        is_same = np.array_equal(found[number], phases_alone(estimate)[number])
        assert is_same == (name != part)


def test_hits_are_probabilities_and_a_cell_without_rays_shows_nothing() -> None:
    estimate, neighbours = expected()
    range_m, intensity, hit = corrected_pano(network(learned=True), estimate, neighbours)
    assert ((hit >= 0) & (hit <= 1)).all() and ((intensity >= 0) & (intensity <= 1)).all()
    assert not any(image[:, :4].any() for image in (range_m, intensity, hit))
    assert np.array_equal(range_m, estimate.median_m)


def test_features_are_finite_and_moderate() -> None:
    features = cell_features(*expected())
    assert torch.isfinite(features).all() and features.abs().max() < 6.0
