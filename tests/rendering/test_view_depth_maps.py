"""Laws of a view's depth by the depth maps of recorded images, of its sources and of its support."""

from dataclasses import replace

import numpy as np
import torch

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recipe.residual import CameraSpec
from nvsf_core.rendering.camera_view import CameraView, camera_view, shown_images
from nvsf_core.rendering.lidar_view import MovingPoints, lidar_view
from nvsf_core.rendering.pixel_support import pixel_support
from nvsf_core.rendering.rendered import Support
from nvsf_core.rendering.source_blend import coarse_colour
from nvsf_core.rendering.sources import SeenPoints, look_up
from nvsf_core.rendering.view_depth_maps import (
    DepthMaps,
    NearMaps,
    ViewDepth,
    baseline_sources,
    camera_distance_m,
    covering_sources,
    depth_in_view,
    image_motions,
    images_beyond,
    images_near,
    spread_ranks,
)
from nvsf_core.rendering.warping import plane_rays

CAMERA = Pinhole(fx=40.0, fy=40.0, cx=31.5, cy=15.5, width=64, height=32)
SPEC = CameraSpec(sources=3, plane_px=64 * 32)
WALL_M, POST_M = 20.0, 4.0


def pose(right_m: float, forward_m: float = 0.0) -> np.ndarray:
    result = np.eye(4)
    result[0, 3], result[2, 3] = right_m, forward_m
    return result


def depth_map(place: np.ndarray) -> np.ndarray:
    """A wall 20 m ahead, and a post 1 m wide in front of it, 4 m ahead of the first image."""
    rays = (np.arange(64) - CAMERA.cx) / CAMERA.fx
    depth_m = np.where(
        np.abs(rays * (POST_M - place[2, 3]) + place[0, 3]) < 0.5, POST_M - place[2, 3], WALL_M - place[2, 3]
    )
    return np.tile(1.0 / depth_m, (32, 1)).astype(np.float32)


def view(
    at: np.ndarray, places: list[np.ndarray], sources: int = 3, maps: list[np.ndarray] | None = None
) -> CameraView:
    images = np.full((len(places), 32, 64, 3), 100, np.uint8)
    inverse = torch.from_numpy(np.stack([depth_map(place) for place in places] if maps is None else maps))
    known = DepthMaps(inverse, torch.zeros(inverse.shape, dtype=torch.int16))
    shown = shown_images(images, np.ones((32, 64), np.bool_), 1).with_depths(known)
    nothing = lidar_view(at, CAMERA, np.zeros((0, 3), np.float32), ())
    return camera_view(
        at, CAMERA, nothing, shown, np.stack(places),
        CameraSpec(sources=sources, plane_px=64 * 32),
    )  # fmt: skip


def support_at(one: CameraView, inverse: torch.Tensor) -> torch.Tensor:
    points = SeenPoints(plane_rays(CAMERA), inverse[None], one.label)
    _, shown = look_up(one.near.of(one.images.full), points, CAMERA)
    return pixel_support(one, inverse, shown[:, 0])


def test_the_front_surface_of_a_view_is_that_of_the_scene() -> None:
    at = pose(0.4, 0.5)
    one = view(at, [pose(x, z) for x in (-0.5, 0.0, 0.5) for z in (0.0, 1.0)])
    assert one.surfaces is not None
    known = one.surfaces.support[0] > 0.0
    error = (one.surfaces.inverse[0] * torch.from_numpy(1.0 / depth_map(at)) - 1.0).abs()
    # Up to the pixels on the post's edges.
    assert known.float().mean() > 0.95 and (error[known] < 0.05).float().mean() > 0.95


def test_what_no_image_shows_is_guessed_and_what_one_shows_from_elsewhere_extrapolated() -> None:
    beside = view(pose(0.1), [pose(0.0), pose(0.2)])
    classes = support_at(beside, torch.from_numpy(depth_map(pose(0.1))))
    wall = np.abs(np.arange(64) - CAMERA.cx) > 12
    assert (classes[:, wall] == Support.SEEN).float().mean() > 0.95
    # From 3 m to the right the post uncovers wall that the images do not show.
    at = pose(3.0)
    away = view(at, [pose(0.0), pose(0.2)])
    classes = support_at(away, torch.from_numpy(depth_map(at)))
    x_m = (np.arange(64) - CAMERA.cx) / CAMERA.fx * WALL_M + 3.0
    hidden = np.abs(x_m) < 1.5
    assert (classes[:, hidden] == Support.GUESSED).all()
    assert (classes[:, (x_m > 4.0) & (x_m < 9.0)] == Support.EXTRAPOLATED).float().mean() > 0.9


def test_a_place_that_an_image_shows_at_an_unconfirmed_depth_is_no_surface_but_not_guessed() -> None:
    at, places = pose(3.0), [pose(0.0), pose(0.2)]
    x_m = (np.arange(64) - CAMERA.cx) / CAMERA.fx * WALL_M + 3.0
    end = (x_m > 4.0) & (x_m < 9.0)
    doubtful = [depth_map(place) for place in places]
    for inverse in doubtful:
        inverse[inverse < 0.5 / POST_M + 0.5 / WALL_M] *= -1.0
    one = view(at, places, maps=doubtful)
    assert one.surfaces is not None
    assert (one.surfaces.support[0][:, end] == 0.0).all()
    assert one.surfaces.glimpsed[:, end].float().mean() > 0.9
    classes = support_at(one, torch.from_numpy(depth_map(at)))
    assert (classes[:, end] == Support.EXTRAPOLATED).float().mean() > 0.9
    # What the post hides from the images nobody saw in any way.
    assert (classes[:, np.abs(x_m) < 1.5] == Support.GUESSED).all()


def test_beside_a_return_the_images_are_asked_whether_they_show_just_that_surface() -> None:
    at, places = pose(3.0), [pose(0.0), pose(0.2)]
    x_m = (np.arange(64) - CAMERA.cx) / CAMERA.fx * WALL_M + 3.0
    end, hidden = (x_m > 4.0) & (x_m < 9.0), np.abs(x_m) < 1.5
    doubtful = [depth_map(place) for place in places]
    for inverse in doubtful:
        inverse[inverse < 0.5 / POST_M + 0.5 / WALL_M] *= -1.0
    truth = torch.from_numpy(depth_map(at))
    one = replace(view(at, places, maps=doubtful), gap_px=torch.zeros(32, 64))
    classes = support_at(replace(one, inverse=truth), truth)
    assert (classes[:, end] == Support.EXTRAPOLATED).float().mean() > 0.9
    assert (classes[:, hidden] == Support.GUESSED).all()
    # Something stands there that the images, which show the wall behind, cannot have seen.
    nearer = torch.full((32, 64), 1.0 / 10.0)
    assert (support_at(replace(one, inverse=nearer), truth)[:, end] == Support.GUESSED).all()
    far_away = replace(one, inverse=nearer, gap_px=torch.full((32, 64), 9.0))
    assert (support_at(far_away, truth)[:, end] == Support.EXTRAPOLATED).float().mean() > 0.9


def test_a_view_asks_images_beyond_those_around_it_for_what_these_do_not_show() -> None:
    places = np.stack([pose(x) for x in (0.0, 0.4, -12.0, -13.0)])
    inverse = torch.full((4, 32, 64), 1.0 / WALL_M)
    wall = DepthMaps(inverse, torch.zeros(inverse.shape, dtype=torch.int16))

    def beyond(right_m: float, maps: DepthMaps, chosen: tuple[int, ...] = (0,)) -> list[int]:
        return images_beyond(CAMERA, image_motions(pose(right_m), places, []), chosen, range(4), maps)

    assert beyond(0.0, wall) == []
    # Both far images show all of the rest; the first is as good as the second, which adds nothing then.
    assert beyond(-6.0, wall) == [2]
    assert beyond(-6.0, wall, (0, 1, 2)) == []
    assert beyond(-6.0, DepthMaps(inverse, wall.mover.index_fill(0, torch.tensor(2), 1))) == [3]
    unconfirmed = inverse.index_fill(0, torch.tensor([2, 3]), -1.0 / WALL_M)
    assert beyond(-6.0, DepthMaps(unconfirmed, wall.mover)) == []


def near_maps(at: np.ndarray, places: np.ndarray, inverse: np.ndarray, mover: np.ndarray) -> NearMaps:
    """Maps of images at `places`, all of whose pixels `mover` (k, H, W) move as what is static does."""
    motions = image_motions(at, places, [np.tile(np.eye(4), (len(places), 1, 1))])
    fronts = [torch.from_numpy(one) for one in np.where(mover > 0, np.float32(1e3), inverse)]
    return NearMaps(motions, list(inverse), list(mover), fronts)


def facing(label: int = 0) -> ViewDepth:
    """The wall alone, static or as a moving object."""
    return ViewDepth(
        torch.full((2, 32, 64), 1.0 / WALL_M), torch.ones(2, 32, 64),
        torch.full((32, 64), label, dtype=torch.uint8), torch.zeros(32, 64, dtype=torch.bool),
    )  # fmt: skip


def wall_maps(count: int) -> np.ndarray:
    """(k, H, W) float32, 1/m: the wall without the post, as all of k images at one place have it."""
    return np.full((count, 32, 64), 1.0 / WALL_M, np.float32)


def test_a_surface_that_fewer_than_half_of_the_maps_have_is_passed_over() -> None:
    for wrong, is_front in ((2, False), (3, True)):
        maps = wall_maps(5)
        maps[:wrong, 8:24, 16:48] = 1.0 / POST_M
        near = near_maps(pose(0.0), np.stack([pose(0.0)] * 5), maps, np.zeros(maps.shape, np.int16))
        found = depth_in_view(CAMERA, near, None)
        middle = (0, slice(10, 22), slice(20, 44))
        torch.testing.assert_close(
            found.inverse[middle], torch.full((12, 24), 1.0 / (POST_M if is_front else WALL_M))
        )
        torch.testing.assert_close(found.support[middle], torch.full((12, 24), 0.6))


def test_a_single_pixel_takes_the_depth_around_it_and_keeps_its_own_as_the_other_surface() -> None:
    maps = wall_maps(2)
    maps[:, 10, 30] = 1.0 / POST_M
    near = near_maps(pose(0.0), np.stack([pose(0.0)] * 2), maps, np.zeros(maps.shape, np.int16))
    found = depth_in_view(CAMERA, near, None)
    expected = torch.full((32, 64), 1.0 / WALL_M)
    torch.testing.assert_close(found.inverse[0], expected)
    own = (1, 10, 30)
    assert float(found.inverse[own]) == np.float32(1.0 / POST_M) and float(found.support[own]) == 0.5
    elsewhere = torch.ones((32, 64), dtype=torch.bool)
    elsewhere[10, 30] = False
    # Bit for bit: kernels look the other surface up only where it is another one.
    assert torch.equal(found.inverse[1][elsewhere], found.inverse[0][elsewhere])
    assert not found.support[1][elsewhere].any()


def test_sources_are_those_that_see_most_together_with_the_nearest_among_them() -> None:
    # Three images beside each other see the same; the last sees around the post.
    places = np.stack([pose(x) for x in (1.8, 1.9, 2.0, -2.0)])
    inverse = np.stack([depth_map(place) for place in places])
    near = near_maps(pose(1.0), places, inverse, np.zeros(inverse.shape, np.uint8))
    assert covering_sources(CAMERA, facing(), near, 3) == [0, 1, 3]
    assert covering_sources(CAMERA, facing(), near, 9) == [0, 1, 2, 3]
    # What shows nothing is no use, however near it is.
    near.fronts[1][:] = 1e3
    assert covering_sources(CAMERA, facing(), near, 3) == [0, 2, 3]


def test_an_image_that_alone_shows_a_part_of_a_view_is_a_source_however_far_it_is() -> None:
    places = np.stack([pose(x) for x in (1.0, 1.1, 1.5, -7.0)])
    inverse = np.full((4, 32, 64), 1.0 / WALL_M, np.float32)
    # The near three do not see a quarter of the view; the third sees a little more of it than the second.
    inverse[:3, :, 24:40] = 1.0 / POST_M
    inverse[1, :, :8] = 1.0 / POST_M
    near = near_maps(pose(1.0), places, inverse, np.zeros(inverse.shape, np.uint8))
    assert covering_sources(CAMERA, facing(), near, 3) == [0, 1, 3]


def test_a_moving_object_is_seen_by_images_that_show_it_and_nothing_in_front() -> None:
    places = np.stack([pose(x) for x in (1.0, 1.1, 1.2, 1.3)])
    inverse = np.full((4, 32, 64), 1.0 / WALL_M, np.float32)
    mover = np.zeros((4, 32, 64), np.uint8)
    mover[2:] = 1
    inverse[2] = 1.0 / POST_M
    near = near_maps(pose(1.0), places, inverse, mover)
    # The second shows static wall there, the third another side of the object, nearer than the wanted one.
    assert covering_sources(CAMERA, facing(1), near, 2) == [0, 3]


def test_a_moving_object_brings_the_images_that_see_it_as_the_view_does() -> None:
    """Twenty images, a metre apart; at the last one's instant the object was as far ahead as in the view."""
    places = np.stack([pose(0.0, -float(k)) for k in range(20)])
    moved = np.tile(np.eye(4), (20, 1, 1))
    moved[:, 2, 3] = 5.0
    moved[19, 2, 3], moved[18] = -19.0, 0.0
    motions = image_motions(pose(0.0), places, [moved])
    alone = images_near(motions, range(20), None)
    assert alone[:4] == [0, 1, 2, 3] and 19 not in alone
    label = torch.zeros(32, 64, dtype=torch.uint8)
    assert images_near(motions, range(20), label) == alone, "it is not in the view"
    label[4:6, 4:6] = 1
    with_it = images_near(motions, range(20), label)
    assert 19 in with_it and set(alone) <= set(with_it) and with_it == sorted(with_it)
    # Where its pose is unknown no image is near to it.
    assert images_near(image_motions(pose(0.0), places, [moved * 0.0]), range(20), label) == alone
    np.testing.assert_allclose(camera_distance_m(motions)[:, [0, 19]], [[0.0, 19.0], [5.0, 0.0]], atol=1e-12)
    assert camera_distance_m(motions)[1, 18] == np.inf


def test_near_instants_bring_the_images_of_all_cameras_and_far_ones_the_nearest() -> None:
    """Twenty places, a metre apart, with two images each, beside one another."""
    left = np.stack([pose(0.0, -float(k)) for k in range(20)])
    right = np.stack([pose(0.5, -float(k)) for k in range(20)])
    motions = image_motions(pose(0.0), np.concatenate([left, right]), [])
    known = np.argsort(camera_distance_m(motions[0]), kind="stable").tolist()
    alone = images_near(motions[:, :20], range(20), None)
    both = images_near(motions, known, None, np.tile(np.arange(20), 2))
    assert [number for number in both if number < 20] == alone
    assert sorted(number for number in both if number >= 20) == [20, 21, 22, 23]
    assert both == [number for number in known if number in both], "the nearest first"


def test_what_moved_through_a_source_leaves_no_ghost_in_a_view_without_it() -> None:
    places = [pose(-0.2), pose(0.0), pose(0.2)]
    images = np.full((3, 32, 64, 3), 100, np.uint8)
    images[:, 10:20, 40:50] = 250
    moving = np.zeros((3, 32, 64), np.bool_)
    moving[:, 8:22, 38:52] = True
    inverse = torch.full((3, 32, 64), 1.0 / WALL_M)
    inverse[torch.from_numpy(moving)] = 0.0
    maps = DepthMaps(inverse, torch.zeros(inverse.shape, dtype=torch.int16))
    shown = shown_images(images, np.ones((32, 64), np.bool_), 1, moving).with_depths(maps)
    nothing = lidar_view(pose(0.1), CAMERA, np.zeros((0, 3), np.float32), ())
    one = camera_view(pose(0.1), CAMERA, nothing, shown, np.stack(places), SPEC)
    assert coarse_colour(one).max() < 0.5


def test_what_maps_show_of_an_object_beyond_its_returns_leaves_no_ghost_either() -> None:
    """A wheel on the road, as far as the road: its depth hides nothing, its object has left."""
    places = [pose(-0.2), pose(0.0), pose(0.2)]
    images = np.full((3, 32, 64, 3), 100, np.uint8)
    images[:, 10:20, 40:50] = 250
    mover = torch.zeros((3, 32, 64), dtype=torch.int16)
    mover[:, 8:22, 38:52] = 4
    maps = DepthMaps(torch.full((3, 32, 64), 1.0 / WALL_M), mover)
    no_returns = np.zeros((3, 32, 64), np.bool_)
    shown = shown_images(images, np.ones((32, 64), np.bool_), 1, no_returns).with_depths(maps)
    nothing = lidar_view(pose(0.1), CAMERA, np.zeros((0, 3), np.float32), ())
    one = camera_view(pose(0.1), CAMERA, nothing, shown, np.stack(places), SPEC)
    assert coarse_colour(one).max() < 0.5


def test_what_a_moving_object_uncovers_is_static_and_its_own_pixels_are_seen_as_it_moves() -> None:
    """A plate 1 m wide, 5 m ahead, and unknown pixels beside it."""
    places = np.stack([pose(0.0), pose(0.1)])
    inverse = np.full((2, 32, 64), 1.0 / WALL_M, np.float32)
    mover = np.zeros((2, 32, 64), np.int16)
    inverse[:, 10:20, 20:28], mover[:, 10:20, 20:28] = 1.0 / 5.0, 300
    inverse[:, :, 27:33] = np.where(mover[:, :, 27:33] > 0, inverse[:, :, 27:33], 0.0)
    maps = DepthMaps(torch.from_numpy(inverse), torch.from_numpy(mover))
    shadow = mover > 0
    shown = shown_images(np.full((2, 32, 64, 3), 90, np.uint8), np.ones((32, 64), np.bool_), 1, shadow)
    moving = [MovingPoints(300, np.array([[-1.0, -0.1, 5.0]], np.float32), np.tile(np.eye(4), (2, 1, 1)))]
    lidar = lidar_view(pose(0.1), CAMERA, np.array([[3.0, 0.0, WALL_M]], np.float32), moving)
    one = camera_view(pose(0.1), CAMERA, lidar, shown.with_depths(maps), places, SPEC, moving=moving)
    assert one.surfaces is not None and one.label is not None
    unknown = (one.surfaces.support[0] == 0.0) & (one.label == 0)
    assert unknown.any() and (one.surfaces.inverse[0][unknown] < 0.06).all()
    assert (one.label == 1).sum() >= 60
    classes = support_at(one, one.surfaces.inverse[0])
    on_plate = torch.zeros(32, 64, dtype=torch.bool)
    on_plate[11:19, 21:27] = True
    assert (one.label[on_plate] == 1).all() and (classes[on_plate] == Support.SEEN).all()


def test_depths_are_found_with_images_at_growing_distances() -> None:
    poses = np.stack([pose(0.0, z) for z in np.arange(0.0, 8.0, 0.25)])
    chosen = baseline_sources(poses, 0, list(range(len(poses))), 4)
    assert poses[chosen][:, 2, 3].tolist() == [0.75, 1.5, 3.0, 6.0]
    assert baseline_sources(poses[:3], 0, [0, 1, 2], 4) == [2, 1]
    poses[1::2, :3, :3] = np.diag([-1.0, 1.0, -1.0])
    chosen = baseline_sources(poses, 0, list(range(len(poses))), 4)
    assert len(chosen) == 4 and all(number % 2 == 0 for number in chosen), "what looks back shows nothing"


def test_ranks_are_dense_at_first_and_reach_far() -> None:
    assert spread_ranks(4) == [0, 1, 2, 3]
    ranks = spread_ranks(60)
    assert ranks[:5] == [0, 1, 2, 3, 4] and len(ranks) == 12 and ranks[-1] > 14
    assert ranks == sorted(set(ranks))


def test_pixels_that_maps_show_as_an_objects_hide_the_street_whatever_returns_say() -> None:
    images, nothing = np.full((2, 32, 64, 3), 100, np.uint8), np.zeros((2, 32, 64), np.bool_)
    mover = torch.zeros(2, 32, 64, dtype=torch.int16)
    mover[1, 10:20, 30:40] = 2
    maps = DepthMaps(torch.full((2, 32, 64), 0.1), mover)
    shown = shown_images(images, np.ones((32, 64), np.bool_), 1, nothing).with_depths(maps)
    assert shown.moving is not None and shown.fronts is not None
    assert torch.equal(shown.moving, mover > 0)
    assert (shown.fronts[mover > 0] > 100.0).all()
    torch.testing.assert_close(shown.fronts[mover == 0], torch.full((int((mover == 0).sum()),), 0.1))
