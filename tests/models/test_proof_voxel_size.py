"""Laws of the choice of voxels: scans that are left out decide, and the evidence keeps what they chose."""

import numpy as np
import pytest

from nvsf_core.evidence.surfels import COARSEST_M, Surfels
from nvsf_core.models.proof import ScanRays, VoxelChoice, choose_coarsest

FAR_M = 50.0
NOBODY = np.zeros(0, np.int64)


def wall_seen_from_one_place(scans: int, rays_a_scan: int, step_m: float) -> ScanRays:
    """A wall 10 m ahead whose surface steps back and forth every 0.15 m, by rays drawn at random."""
    generator = np.random.default_rng(0)
    count = scans * rays_a_scan
    y, z = generator.uniform(-2.0, 2.0, count), generator.uniform(-1.0, 1.0, count)
    x = 10.0 + step_m * (np.floor(y / 0.15) % 2.0)
    points = np.stack([x, y, z], axis=1)
    range_m = np.linalg.norm(points, axis=1)
    return ScanRays(
        origin_m=np.zeros((count, 3), np.float32),
        direction=(points / range_m[:, None]).astype(np.float32),
        range_m=range_m.astype(np.float32),
        intensity=np.full(count, 0.5, np.float32),
        scan=np.repeat(np.arange(scans), rays_a_scan),
        is_static=np.ones(count, bool),
    )


def chosen(rays: ScanRays, unidentified: np.ndarray = NOBODY) -> VoxelChoice | None:
    return choose_coarsest(rays, np.arange(rays.scan.max() + 1), unidentified=unidentified, far_m=FAR_M)


def found(rays: ScanRays, unidentified: np.ndarray = NOBODY) -> VoxelChoice:
    choice = chosen(rays, unidentified)
    assert choice is not None
    return choice


def edges_m(surfels: Surfels) -> set[float]:
    return {round(surfels.index.voxel_m * edge, 3) for edge in surfels.index.edges.tolist()}


def test_what_is_seen_densely_and_is_not_flat_gets_the_finest_voxels() -> None:
    choice = found(wall_seen_from_one_place(8, 20_000, 0.1))
    assert choice.coarsest_m == COARSEST_M[0]
    assert edges_m(choice.left_out.for_rendering) <= {0.1, 0.2} and edges_m(choice.left_out.static) == {0.2}
    assert all(0.0 < error_m < 1.0 for error_m in choice.errors_m.values())


def test_what_is_seen_sparsely_and_is_flat_gets_coarse_ones_whose_gaps_are_closed() -> None:
    choice = found(wall_seen_from_one_place(8, 40, 0.0))
    assert choice.coarsest_m == COARSEST_M[-1] and 0.8 in edges_m(choice.left_out.for_rendering)
    assert choice.errors_m[COARSEST_M[-1]] < 0.5 * choice.errors_m[COARSEST_M[0]]


def test_the_choice_is_the_same_every_time_and_is_not_made_of_too_few_scans() -> None:
    rays = wall_seen_from_one_place(8, 400, 0.1)
    assert found(rays).errors_m == found(rays).errors_m
    assert chosen(wall_seen_from_one_place(2, 400, 0.1)) is None


@pytest.mark.parametrize("scans", [3, 5])
def test_of_a_few_scans_the_middle_one_judges(scans: int) -> None:
    left_out = found(wall_seen_from_one_place(scans, 400, 0.1)).left_out
    assert left_out.validation.tolist() == [scans // 2]
    assert int(left_out.static.hits.sum()) == (scans - 1) * 400


def test_moving_objects_do_not_vote_on_the_size() -> None:
    rays = wall_seen_from_one_place(8, 400, 0.1)
    rays.is_static[:] = False
    assert chosen(rays) is None


def test_what_judges_are_judged_by_is_proven_by_the_others_alone() -> None:
    rays = wall_seen_from_one_place(8, 400, 0.1)
    left_out = found(rays).left_out
    assert len(left_out.validation) == 2 and len(left_out.static.precision) == 0
    for surfels in (left_out.static, left_out.for_rendering):
        assert int(surfels.hits.sum()) == int((~np.isin(rays.scan, left_out.validation)).sum())


def test_silent_scans_prove_but_never_judge() -> None:
    rays = wall_seen_from_one_place(8, 400, 0.1)
    unidentified = found(rays).left_out.validation[:1]
    left_out = found(rays, unidentified).left_out
    assert len(np.unique(left_out.validation)) == 2
    assert not np.isin(unidentified, left_out.validation).any()
    assert int(left_out.static.hits.sum()) == 6 * 400
    assert chosen(rays, np.arange(6)) is None
