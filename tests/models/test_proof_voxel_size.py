"""Laws of the choice of voxels: scans that are left out decide, and the evidence keeps what they chose."""

import numpy as np
import pytest

from nvsf_core.models.proof import (
    CANDIDATES_M,
    FIELD_VOXEL_M,
    ScanRays,
    VoxelChoice,
    choose_voxel_m,
)

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


def chosen(rays: ScanRays) -> VoxelChoice:
    choice = choose_voxel_m(rays, unidentified=NOBODY, far_m=FAR_M)
    assert choice is not None
    return choice


def test_what_is_seen_densely_and_is_not_flat_gets_the_finest_voxels() -> None:
    choice = chosen(wall_seen_from_one_place(8, 4000, 0.1))
    assert choice.best_m == CANDIDATES_M[0]
    assert all(0.0 < found < 1.0 for found in choice.errors_m.values())


def test_what_is_seen_sparsely_gets_coarse_ones_whose_gaps_are_closed() -> None:
    choice = chosen(wall_seen_from_one_place(8, 25, 0.0))
    assert list(choice.errors_m) == list(CANDIDATES_M) and choice.best_m == CANDIDATES_M[-1]


def test_the_choice_is_the_same_every_time_and_is_not_made_of_too_few_scans() -> None:
    rays = wall_seen_from_one_place(8, 400, 0.1)
    assert chosen(rays).errors_m == chosen(rays).errors_m
    few = wall_seen_from_one_place(2, 400, 0.1)
    assert choose_voxel_m(few, unidentified=NOBODY, far_m=FAR_M) is None


@pytest.mark.parametrize("scans", [3, 5])
def test_of_a_few_scans_the_middle_one_judges(scans: int) -> None:
    choice = chosen(wall_seen_from_one_place(scans, 400, 0.1))
    assert choice.validation.tolist() == [scans // 2]
    assert int(choice.static.hits.sum()) == (scans - 1) * 400


def test_moving_objects_do_not_vote_on_the_size() -> None:
    rays = wall_seen_from_one_place(8, 400, 0.1)
    rays.is_static[:] = False
    assert choose_voxel_m(rays, unidentified=NOBODY, far_m=FAR_M) is None


def test_the_surfels_of_the_chosen_size_see_what_others_leave() -> None:
    rays = wall_seen_from_one_place(8, 400, 0.0)
    rays.is_static[::2] = False
    _, surfels = rays.surfels(0.3)
    assert surfels.index.voxel_m == 0.3
    assert int(surfels.hits.sum()) == int(rays.is_static.sum())
    assert surfels.mean_m[:, 0] == pytest.approx(10.0, abs=1e-3)


def test_what_judges_are_judged_by_is_proven_by_the_others_alone() -> None:
    rays = wall_seen_from_one_place(8, 400, 0.1)
    choice = chosen(rays)
    assert len(choice.validation) == 2 and choice.static.index.voxel_m == FIELD_VOXEL_M
    assert len(choice.static.precision) == 0
    for surfels in (choice.static, *choice.rendered.values()):
        assert int(surfels.hits.sum()) == int((~np.isin(rays.scan, choice.validation)).sum())


def test_silent_scans_prove_but_never_judge() -> None:
    rays = wall_seen_from_one_place(8, 400, 0.1)
    unidentified = chosen(rays).validation[:1]
    choice = choose_voxel_m(rays, unidentified=unidentified, far_m=FAR_M)
    assert choice is not None and len(np.unique(choice.validation)) == 2
    assert not np.isin(unidentified, choice.validation).any()
    assert int(choice.static.hits.sum()) == 6 * 400
    assert choose_voxel_m(rays, unidentified=np.arange(6), far_m=FAR_M) is None
