"""Laws of the paper's joined field."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from nvsf_core.errors import RecipeError
from nvsf_core.fields.flow import FlowField, applied
from nvsf_core.fields.raydrop_unet import RaydropUnet
from nvsf_core.fields.scene_field import SceneField
from nvsf_core.recipe.paper import (
    EncoderSpec,
    FlowSpec,
    GridSpec,
    PaperOptimiser,
    PaperRecipe,
    PaperSampling,
    PlanesSpec,
    ReferenceQuirks,
    TimeGridSpec,
)

GRID = GridSpec(levels=2, features=4, log2_table=8, base_resolution=4, finest_resolution=32)
SMALL = PaperRecipe(
    name="small",
    encoder=EncoderSpec(
        static=GRID,
        dynamic=TimeGridSpec(
            slices=4, levels=2, log2_tables=(7, 6, 6), base_resolution=4, finest_resolution=32
        ),
        planes=PlanesSpec(scales=(1, 2), features=4, space_resolution=4, time_resolution=3),
    ),
    flow=FlowSpec(grid=replace(GRID, features=8), hidden=16),
)
FRAMES = 5


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _field(recipe: PaperRecipe = SMALL, frames: int = FRAMES) -> SceneField:
    """A field whose numbers are large enough that every part shows."""
    field = SceneField(recipe, frames, _generator())
    generator = _generator(1)
    with torch.no_grad():
        for parameter in [*field.encoders.parameters(), *field.flow.parameters()]:
            parameter.uniform_(-0.5, 0.5, generator=generator)
    return field


def _points(n: int = 64) -> torch.Tensor:
    return 0.2 + 0.6 * torch.rand(n, 3, generator=_generator(2))


def _directions(n: int = 64) -> torch.Tensor:
    return nn.functional.normalize(torch.randn(n, 3, generator=_generator(3)), dim=1)


def _count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_paper_has_100_112_289_parameters() -> None:
    generator = torch.Generator(device="cpu")
    field = SceneField(PaperRecipe(name="paper"), 51, generator)
    unet = RaydropUnet(32, generator)
    assert [_count(encoder) for encoder in field.encoders] == [31_541_248, 31_541_248]
    one = field.encoders[0]
    assert [_count(m) for m in (one.static_hash, one.dynamic_hash, one.planes)] == [
        16_777_216,
        12_582_912,
        2_181_120,
    ]
    assert _count(field.flow) == 30_459_392
    heads = [field.density_network, field.intensity, field.hit, field.colour]
    assert [_count(head) for head in heads] == [8_704, 9_728, 9_728, 6_272]
    assert sum(_count(head) for head in heads) == 34_432
    assert _count(unet) == 6_535_969
    assert _count(field) + _count(unet) == 100_112_289


@pytest.mark.parametrize("frame", [0, 1, 2.5, 4])
def test_dynamic_features_are_half_own_and_a_quarter_of_each_neighbour(frame: float) -> None:
    field = _field()
    encoder, x01, t = field.encoders[0], _points(), frame / (FRAMES - 1)
    flows = field.flow(x01, t)
    own = encoder.dynamic(x01, t)
    parts = [
        encoder.dynamic(x01 + flow / 2, (frame + step) / (FRAMES - 1)) if 0 <= frame + step <= 4 else own
        for step, flow in zip((1, -1), flows, strict=True)
    ]
    expected = torch.cat([encoder.static(x01), 0.5 * own + 0.25 * (parts[0] + parts[1])], dim=1)
    sigma, geometry = field.density_network(expected)
    found_sigma, found_geometry = field.density(x01, frame, "lidar")
    assert torch.allclose(found_sigma, sigma, rtol=1e-5)
    assert torch.allclose(found_geometry, geometry, atol=1e-5)
    assert found_sigma.shape == (64,) and found_geometry.shape == (64, 15)


def test_a_single_frame_and_a_field_without_aggregation_never_ask_for_the_flow() -> None:
    alone, switched_off = _field(frames=1), _field(replace(SMALL, aggregate=False))
    for field, frame, t in ((alone, 0, 0.0), (switched_off, 2, 0.5)):
        x01 = _points()
        sigma, _ = field.density(x01, frame, "lidar")
        own = torch.cat([field.encoders[0].static(x01), field.encoders[0].dynamic(x01, t)], dim=1)
        assert torch.equal(sigma, field.density_network(own)[0])
        sigma.sum().backward()
        assert all(parameter.grad is None for parameter in field.flow.parameters())


def test_rendering_trains_the_flow_through_the_planes() -> None:
    field = _field()
    field.density(_points(), 2, "lidar")[0].sum().backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in field.flow.parameters())
    with torch.no_grad():
        for plane in field.encoders[0].planes.time:
            plane.fill_(1.0)
    field.zero_grad()
    field.density(_points(), 2, "lidar")[0].sum().backward()
    assert all(p.grad is None or p.grad.abs().max() == 0 for p in field.flow.parameters())


def test_neighbours_leave_the_hash_tables_of_their_own_times_alone() -> None:
    field = _field()
    field.density(_points(), 2, "lidar")[0].sum().backward()
    # t = 0.5 lies between the slices 1 and 2 of 4; the neighbours at 0.25 and 0.75 between 0, 1 and 2, 3
    row = field.encoders[0].dynamic_hash.planes[0]
    assert [grid.table.grad is not None for grid in row] == [False, True, True, False]


def test_each_sensor_trains_the_encoding_that_its_strategy_gives_it() -> None:
    def learns(encoders: str, sensor: str) -> list[bool]:
        field = _field(replace(SMALL, encoders=encoders))
        sigma, geometry = field.density(_points(), 2, sensor)
        assert torch.isfinite(sigma).all() and geometry.shape == (64, 15)
        sigma.sum().backward()
        return [encoder.static_hash.table.grad is not None for encoder in field.encoders]

    assert learns("same", "lidar") == learns("same", "camera") == [True]
    assert learns("separate", "lidar") == [True, False]
    assert learns("separate", "camera") == [False, True]
    assert learns("separate_fused", "lidar") == learns("separate_fused", "camera") == [True, True]


def test_fused_encodings_lead_with_the_sensors_own() -> None:
    field = _field(replace(SMALL, encoders="separate_fused"))
    swapped = _field(replace(SMALL, encoders="separate_fused"))
    swapped.encoders = nn.ModuleList(reversed(list(swapped.encoders)))
    x01 = _points()
    assert torch.equal(field.density(x01, 2, "camera")[0], swapped.density(x01, 2, "lidar")[0])
    assert not torch.equal(field.density(x01, 2, "lidar")[0], swapped.density(x01, 2, "lidar")[0])


def test_without_camera_rays_nothing_of_the_camera_is_built() -> None:
    lidar_only = replace(SMALL, sampling=PaperSampling(camera=False))
    for encoders in ("same", "separate", "separate_fused"):
        field = _field(replace(lidar_only, encoders=encoders))
        assert len(field.encoders) == 1 and field.colour is None
        sigma, geometry = field.density(_points(), 2, "lidar")
        assert torch.isfinite(sigma).all()
        with pytest.raises(RecipeError, match="camera"):
            field.camera(_directions(), geometry)


def test_the_authors_flow_goes_two_bounds_too_far() -> None:
    displacement = torch.tensor([[0.1, -0.2, 0.3]])
    for bound in (1.0, 2.0):
        slip = applied(displacement, ReferenceQuirks(flow_unit=True, bound=bound))
        assert torch.allclose(slip, 2 * bound * applied(displacement, ReferenceQuirks(bound=bound)))
    x01 = _points()
    moved = dict(enumerate(_field().neighbours(x01, 2)))
    slipped = dict(
        enumerate(_field(replace(SMALL, slips=ReferenceQuirks(flow_unit=True))).neighbours(x01, 2))
    )
    assert torch.allclose(slipped[0][0] - x01, 2 * (moved[0][0] - x01), atol=1e-6)


def test_neighbours_have_the_times_of_their_frames_and_under_the_slip_others() -> None:
    slipped = _field(replace(SMALL, slips=ReferenceQuirks(neighbour_times=True)))
    assert [t for _, t in _field().neighbours(_points(), 3)] == [1.0, 0.5]
    assert [t for _, t in slipped.neighbours(_points(), 3)] == [pytest.approx(0.8), pytest.approx(0.4)]
    assert [t for _, t in _field().neighbours(_points(), 0)] == [0.25]


def test_the_flow_contracts_its_nodes_first_and_starts_near_zero() -> None:
    flow = FlowField(SMALL.flow, _generator())
    forward, backward = flow(_points(), 0.3)
    assert forward.shape == backward.shape == (64, 3)
    assert max(forward.abs().max(), backward.abs().max()) < 1e-4
    with torch.no_grad():
        flow.grid.table.uniform_(-1, 1, generator=_generator(4))
    t = 0.3
    basis = [
        (t - 1 / 3) * (t - 2 / 3) * (t - 1) * -4.5,
        t * (t - 2 / 3) * (t - 1) * 13.5,
        t * (t - 1 / 3) * (t - 1) * -13.5,
        t * (t - 1 / 3) * (t - 2 / 3) * 4.5,
    ]
    by_level = flow.grid(_points()).reshape(64, 2, 4, 2)
    slow = sum(basis[j] * by_level[:, :, j] for j in range(4)).reshape(64, 4)
    assert torch.allclose(flow.network(slow), torch.cat(flow(_points(), t), dim=1), atol=1e-6)


def test_answers_are_probabilities_and_a_rays_samples_share_its_direction() -> None:
    field = _field()
    _, geometry = field.density(_points(), 2, "lidar")
    intensity, hit = field.lidar(_directions(), geometry).unbind(-1)
    colour = field.camera(_directions(), geometry)
    assert intensity.shape == hit.shape == (64,) and colour.shape == (64, 3)
    for answer in (intensity, hit, colour):
        assert ((answer > 0) & (answer < 1)).all()
    per_ray = _directions(8)
    of_samples = field.lidar(per_ray[:, None], geometry.reshape(8, 8, 15))
    one_by_one = field.lidar(per_ray.repeat_interleave(8, dim=0), geometry)
    assert torch.allclose(of_samples.flatten(0, 1), one_by_one, atol=1e-6)


def test_every_parameter_is_in_one_group() -> None:
    field = _field()
    groups = field.parameter_groups(PaperOptimiser(head_rate=2e-3))
    assert [group["lr"] for group in groups] == [1e-2, 2e-3, 1e-3]
    ids = [id(p) for group in groups for p in group["params"]]
    assert sorted(ids) == sorted(id(p) for p in field.parameters())
    for group, modules in ((groups[1], (field.intensity, field.hit)), (groups[2], (field.flow,))):
        assert {id(p) for p in group["params"]} == {id(p) for m in modules for p in m.parameters()}


def test_all_is_finite_at_the_corners_and_beyond() -> None:
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0, 2.0])] * 3)
    field = _field()
    for frame in (0, 1.5, 4):
        sigma, geometry = field.density(corners, frame, "camera")
        (sigma.sum() + geometry.sum()).backward()
        assert torch.isfinite(sigma).all() and torch.isfinite(geometry).all()
    assert all(torch.isfinite(p.grad).all() for p in field.parameters() if p.grad is not None)
    assert field.density(corners[:0], 2, "lidar")[1].shape == (0, 15)


def test_the_same_generator_draws_the_same_field() -> None:
    first, again = (SceneField(SMALL, FRAMES, _generator()) for _ in range(2))
    torch.manual_seed(0)
    for a, b in zip(first.parameters(), again.parameters(), strict=True):
        assert torch.equal(a, b)
    alike = SceneField(replace(SMALL, slips=ReferenceQuirks(identical_tables=True)), FRAMES, _generator())
    assert torch.equal(alike.encoders[0].static_hash.table, alike.encoders[1].static_hash.table)
    assert not torch.equal(first.encoders[0].static_hash.table, first.encoders[1].static_hash.table)
