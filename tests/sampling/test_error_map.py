"""Laws of heuristic sampling."""

import pytest
import torch

from nvsf_core.errors import DivergedError, ShapeError
from nvsf_core.sampling.error_map import CAMERA_CELL_PX, LIDAR_CELL_PX, ErrorMap
from nvsf_core.stores.checkpoints import load_tensors, save_tensors


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_maps_have_half_the_pano_and_a_quarter_of_the_image() -> None:
    assert ErrorMap(60, 66, 1030, LIDAR_CELL_PX).errors.shape == (60, 33, 515)
    assert ErrorMap(2, 376, 1408, CAMERA_CELL_PX).errors.shape == (2, 94, 352)
    assert (ErrorMap(2, 5, 7, 4).errors == torch.ones(2, 2, 2)).all()


def test_an_update_keeps_a_tenth_and_takes_nine_of_the_normalised_error() -> None:
    error_map = ErrorMap(2, 4, 4, 2)
    rows, columns = torch.tensor([0, 0, 3]), torch.tensor([0, 3, 3])
    error_map.update(1, rows, columns, torch.tensor([5.0, 7.0, 9.0]))
    assert torch.allclose(error_map.errors[1], torch.tensor([[1.0, 0.1 + 0.9 * 500.5], [1.0, 900.1]]))
    assert (error_map.errors[0] == 1.0).all()


def test_of_several_rays_in_a_cell_the_largest_error_counts_in_any_order() -> None:
    rows, columns = torch.tensor([0, 1, 0, 3]), torch.tensor([1, 0, 0, 3])
    error = torch.tensor([1.0, 3.0, 2.0, 5.0])
    maps = []
    for order in ([0, 1, 2, 3], [3, 2, 1, 0]):
        error_map = ErrorMap(1, 4, 4, 2)
        error_map.update(0, rows[order], columns[order], error[order])
        maps.append(error_map.errors)
    assert torch.equal(*maps)
    assert torch.isclose(maps[0][0, 0, 0], torch.tensor(0.1 + 0.9 * 500.5))


@pytest.mark.parametrize("error", [[], [3.0], [2.0, 2.0, 2.0]])
def test_a_batch_that_ranks_nothing_changes_nothing(error: list[float]) -> None:
    error_map = ErrorMap(1, 4, 4, 2)
    pixels = torch.arange(len(error))
    error_map.update(0, pixels, pixels, torch.tensor(error))
    assert (error_map.errors == 1.0).all()


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_an_error_that_is_not_finite_is_refused_and_changes_nothing(bad: float) -> None:
    error_map = ErrorMap(1, 4, 4, 2)
    pixels = torch.arange(2)
    with pytest.raises(DivergedError, match="frame 0"):
        error_map.update(0, pixels, pixels, torch.tensor([1.0, bad]))
    assert (error_map.errors == 1.0).all()


def test_huge_errors_do_not_overflow() -> None:
    error_map = ErrorMap(1, 4, 4, 2)
    error_map.update(0, torch.tensor([0, 3]), torch.tensor([0, 3]), torch.tensor([-3e38, 3e38]))
    assert torch.allclose(error_map.errors[0], torch.tensor([[1.0, 1.0], [1.0, 900.1]]))


def test_pixels_of_wrong_cells_are_drawn_more_often_and_none_twice_a_round() -> None:
    error_map = ErrorMap(1, 16, 16, 2)
    error_map.errors[0, :4] = 1000.0
    rows, columns = error_map.sample_pixels(0, 32, generator())
    assert (rows < 8).float().mean() > 0.9
    cells = rows // 2 * 8 + columns // 2
    assert len(cells.unique()) == 32
    assert len((rows % 2).unique()) == len((columns % 2).unique()) == 2


def test_every_cell_has_a_chance_and_many_draws_are_full_rounds() -> None:
    error_map = ErrorMap(1, 5, 7, 4)
    rows, columns = error_map.sample_pixels(0, 4 * 25, generator())
    counts = torch.bincount(rows // 4 * 2 + columns // 4, minlength=4)
    assert (counts == 25).all()
    assert rows.max() == 4 and columns.max() == 6


def test_corners_keep_their_patches_within_the_image_and_reach_its_last_row() -> None:
    error_map = ErrorMap(1, 6, 20, 2)
    rows, columns = error_map.sample_patches(0, 200, (2, 8), generator())
    assert rows.min() == 0 and rows.max() == 4
    assert columns.min() == 0 and columns.max() == 12
    with pytest.raises(ShapeError):
        error_map.sample_patches(0, 1, (7, 8), generator())


def test_pixels_that_show_nothing_are_never_drawn() -> None:
    drawable = torch.zeros(9, 10, dtype=torch.bool)
    drawable[3, 4:9] = True
    error_map = ErrorMap(1, 9, 10, 4, drawable)
    rows, columns = error_map.sample_pixels(0, 64, generator())
    assert drawable[rows, columns].all()
    assert len(columns.unique()) == 5
    with pytest.raises(ShapeError, match="shows something"):
        ErrorMap(1, 9, 10, 4, torch.zeros(9, 10, dtype=torch.bool))


def test_nothing_drawn_is_no_error() -> None:
    error_map = ErrorMap(1, 4, 4, 2)
    assert error_map.sample_pixels(0, 0, generator())[0].shape == (0,)
    assert error_map.sample_patches(0, 0, (2, 2), generator())[0].shape == (0,)


def test_its_state_survives_a_checkpoint(tmp_path) -> None:
    error_map, other = ErrorMap(1, 8, 8, 2), ErrorMap(1, 8, 8, 2)
    error_map.update(0, torch.tensor([0, 7]), torch.tensor([0, 7]), torch.tensor([1.0, 2.0]))
    save_tensors(tmp_path / "map.safetensors", error_map.state_dict())
    other.load_state_dict(load_tensors(tmp_path / "map.safetensors")[0])
    assert torch.equal(*(torch.stack(m.sample_pixels(0, 9, generator(2))) for m in (error_map, other)))
