"""Laws of the encodings of space and time: what is contracted first equals what is contracted last."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nvsf_core.encodings.hash_time import HashTime, cubic_basis
from nvsf_core.encodings.hybrid import HybridEncoding
from nvsf_core.encodings.planes import Planes4D
from nvsf_core.errors import RecipeError
from nvsf_core.kernels.encodings.hash_grid import HashGrid, hash_grid_encode, start_alike
from nvsf_core.recipe.paper import EncoderSpec, GridSpec, PlanesSpec, TimeGridSpec

TIME = TimeGridSpec(slices=5, levels=3, log2_tables=(9, 8, 7), base_resolution=8, finest_resolution=64)
PLANES = PlanesSpec(scales=(1, 2), features=4, space_resolution=5, time_resolution=4)
TIMES = (0.0, 0.1, 1 / 3, 0.5, 0.75, 0.99, 1.0)
PAIRS = ((0, 1), (0, 2), (1, 2))


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _points(n: int = 200) -> torch.Tensor:
    """Random points, the cube's corners, and points outside of it."""
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
    return torch.cat([torch.rand(n, 3, generator=_generator(1)), corners, 3.0 * corners - 1.0])


def _spread(module: torch.nn.Module) -> None:
    """Numbers of order 1, so that differences show."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.uniform_(-1.0, 1.0, generator=_generator(2))


@settings(deadline=None)
@given(st.floats(0.0, 1.0))
def test_the_basis_reproduces_every_cubic(t: float) -> None:
    nodes = torch.tensor([0.0, 1 / 3, 2 / 3, 1.0], dtype=torch.float64)
    for power in range(4):
        assert (cubic_basis(t) @ nodes**power).item() == pytest.approx(t**power, abs=1e-12)


@pytest.mark.parametrize("t", [-0.01, 1.01, float("nan")])
def test_there_is_no_time_outside_the_clip(t: float) -> None:
    with pytest.raises(ValueError, match=r"\[0, 1\]"):
        cubic_basis(t)


@pytest.mark.parametrize("t", TIMES)
def test_contracting_the_dynamic_hash_over_time_first_changes_nothing(t: float) -> None:
    encoding = HashTime(TIME, _generator())
    _spread(encoding)
    x01 = _points()
    place = t * (TIME.slices - 1)
    lower, upper = int(place), min(int(place) + 1, TIME.slices - 1)
    slow = []
    for plane, axes in enumerate(PAIRS):
        first, second = (
            hash_grid_encode(x01[:, axes], encoding.planes[plane][k].table, encoding.planes[plane][k].layout)
            for k in (lower, upper)
        )
        blended = torch.lerp(first, second, place - lower).reshape(len(x01), TIME.levels, 4)
        slow.append(blended @ cubic_basis(t).float())
    assert torch.allclose(encoding(x01, t), torch.cat(slow, dim=1), atol=2e-6)


@pytest.mark.parametrize("t", TIMES)
def test_planes_are_products_of_their_bilinear_samples(t: float) -> None:
    planes = Planes4D(PLANES, _generator())
    _spread(planes)
    x01 = _points()

    def sample(plane: torch.Tensor, first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        grid = (torch.stack([first, second], dim=1) * 2 - 1)[None, None]
        options = {"mode": "bilinear", "padding_mode": "border", "align_corners": True}
        return torch.nn.functional.grid_sample(plane[None], grid, **options)[0, :, 0].T

    at = torch.full((len(x01),), t)
    static, dynamic = [], []
    for scale in range(2):
        space, time = planes.space[3 * scale : 3 * scale + 3], planes.time[3 * scale : 3 * scale + 3]
        a, b, c = (sample(p, x01[:, i], x01[:, j]) for p, (i, j) in zip(space, PAIRS, strict=True))
        static.append(a * b * c)
        a, b, c = (sample(p, x01[:, axis], at) for axis, p in enumerate(time))
        dynamic.append(a * b * c)
    assert torch.allclose(planes.static(x01), torch.cat(static, dim=1), atol=1e-5)
    assert torch.allclose(planes.dynamic(x01, t), torch.cat(dynamic, dim=1), atol=1e-5)


def test_planes_of_time_start_without_any_effect() -> None:
    planes = Planes4D(PLANES, _generator())
    assert torch.allclose(planes.dynamic(_points(), 0.37), torch.ones(()))
    space = torch.cat([p.detach().flatten() for p in planes.space])
    assert space.min() >= 0.1 and space.max() <= 0.5


def test_only_the_slices_beside_the_time_learn() -> None:
    encoding = HashTime(TIME, _generator())
    encoding(_points(), 0.3).sum().backward()
    learns = [[grid.table.grad is not None for grid in row] for row in encoding.planes]
    assert learns == [[False, True, True, False, False]] * 3
    encoding.zero_grad()
    encoding(_points(), 0.5).sum().backward()
    assert [grid.table.grad is not None for grid in encoding.planes[0]] == [False, False, True, False, False]


def test_the_hybrid_encoding_has_the_papers_sizes() -> None:
    with torch.device("meta"):
        assert HybridEncoding(EncoderSpec(), _generator_on_cpu()).outputs == (64, 56)


def _generator_on_cpu() -> torch.Generator:
    return torch.Generator(device="cpu")


def _small_hybrid() -> HybridEncoding:
    grid = GridSpec(levels=3, features=4, log2_table=9, base_resolution=8, finest_resolution=64)
    return HybridEncoding(EncoderSpec(static=grid, dynamic=TIME, planes=PLANES), _generator())


def test_without_hash_gradient_positions_are_reached_through_the_planes_alone() -> None:
    encoding = _small_hybrid()
    _spread(encoding)
    x01 = (0.1 + 0.8 * torch.rand(50, 3, generator=_generator(3))).requires_grad_()
    encoding.dynamic(x01, 0.4, hash_gradient=False).sum().backward()
    assert all(p.grad is None for p in encoding.dynamic_hash.parameters())
    assert any(p.grad is not None for p in encoding.planes.time)
    planes_only = x01.detach().clone().requires_grad_()
    encoding.planes.dynamic(planes_only, 0.4).sum().backward()
    assert x01.grad is not None and torch.equal(x01.grad, planes_only.grad)
    assert x01.grad.abs().max() > 0


@settings(max_examples=20, deadline=None)
@given(st.floats(0.0, 1.0), st.floats(-2.0, 3.0))
def test_features_are_finite_wherever_and_whenever(t: float, coordinate: float) -> None:
    x01 = torch.tensor([[coordinate, 0.0, 1.0], [1.0, coordinate, coordinate]])
    encoding = HybridEncoding(
        EncoderSpec(
            static=GridSpec(levels=2, features=4, log2_table=6, base_resolution=4, finest_resolution=16),
            dynamic=TimeGridSpec(levels=2, log2_tables=(6, 6, 6), base_resolution=4, finest_resolution=16),
            planes=PLANES,
        ),
        _generator(),
    )
    assert torch.isfinite(encoding.static(x01)).all() and torch.isfinite(encoding.dynamic(x01, t)).all()


def test_alike_grids_of_one_layout_start_with_the_same_numbers() -> None:
    encoding = HashTime(TIME, _generator())
    tables = [grid.table for grid in encoding.modules() if isinstance(grid, HashGrid)]
    assert not torch.equal(tables[0], tables[1])
    start_alike(encoding)
    assert all(torch.equal(a, b) for a in tables for b in tables if a.shape == b.shape)


def test_an_entry_must_hold_the_four_nodes() -> None:
    with pytest.raises(RecipeError, match="expected 4 features"):
        HashTime(TimeGridSpec(features=2), _generator())
