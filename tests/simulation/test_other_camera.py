"""Cameras of other intrinsics, and beams with a width."""

import numpy as np
import pytest

from nvsf_core.errors import DataError
from nvsf_core.geometry.camera_fan import camera_rays, covering_rotations, require_coverage
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.rendering.rendered import RenderedImage, RenderedRays
from nvsf_core.simulation.footprint import render_beams
from nvsf_core.simulation.other_camera import OtherCamera

RECORDED = Pinhole(fx=80.0, fy=80.0, cx=60.0, cy=40.0, width=120, height=80)


def _sky(pose: np.ndarray) -> RenderedImage:
    """A world at infinity whose colour is its direction, as the recorded intrinsics see it."""
    rays = RECORDED.rays(RECORDED.pixels()) @ pose[:3, :3].T
    return RenderedImage(_colour(rays), np.full(rays.shape[:2], 7.0, np.float32))


def _colour(rays: np.ndarray) -> np.ndarray:
    return np.rint(127.5 + 120.0 * rays).astype(np.uint8)


@pytest.mark.parametrize(
    "model",
    [
        Pinhole(fx=150.0, fy=140.0, cx=90.0, cy=50.0, width=200, height=100),
        Pinhole(fx=40.0, fy=40.0, cx=99.5, cy=49.5, width=200, height=100),
        MeiFisheye(
            xi=2.2, k1=0.017, k2=1.65, p1=0.0, p2=0.0, gamma1=115.0, gamma2=115.0, u0=60.0, v0=60.0,
            width=120, height=120,
        ),
    ],
    ids=["narrower", "wider", "fisheye"],
)  # fmt: skip
def test_another_camera_shows_along_its_own_rays_what_the_recorded_one_would(model) -> None:
    other = OtherCamera.of(model, RECORDED)
    shown = other.render(np.eye(4), _sky)
    if isinstance(model, Pinhole):
        rays, seen = model.rays(model.pixels()), np.ones((model.height, model.width), bool)
    else:
        v, u = np.mgrid[0 : model.height, 0 : model.width]
        rays, seen = model.unproject(np.stack([u, v], axis=-1).astype(float))
    inside = other.source >= 0
    assert (inside == (seen & np.isfinite(rays).all(axis=-1))).all(), "every pixel of the lens is covered"
    apart = np.abs(shown.rgb[inside].astype(int) - _colour(rays[inside]))
    assert apart.max() <= 2
    assert (shown.range_m[inside] == 7.0).all() and not np.isfinite(shown.range_m[~inside]).any()


def test_a_camera_of_which_images_leave_pixels_out_is_refused() -> None:
    aside = Pinhole(fx=50.0, fy=50.0, cx=-20.0, cy=39.5, width=100, height=80)
    wide = Pinhole(fx=21.4, fy=21.4, cx=79.5, cy=79.5, width=160, height=160)
    for refuses in (OtherCamera.of, require_coverage):
        with pytest.raises(DataError, match=r"found [23]\.\d\d% of its pixels outside"):
            refuses(wide, aside)


def test_some_pixels_tell_before_anything_is_trained_how_many_images_all_of_them_need() -> None:
    model = Pinhole(fx=300.0, fy=300.0, cx=599.5, cy=299.5, width=1200, height=600)
    rays, seen = camera_rays(model, step_px=4)
    assert rays.shape == (151, 301, 3) and seen.all()
    every = camera_rays(model)[0]
    assert np.array_equal(rays[-1, -1], every[-1, -1]) and np.array_equal(rays[1, 2], every[4, 8])
    found = covering_rotations(rays.reshape(-1, 3), RECORDED)
    assert len(found) == len(OtherCamera.of(model, RECORDED).rotations)


def test_a_beam_at_an_edge_gives_the_range_of_its_stronger_side_and_a_thin_ray_its_own() -> None:
    def render(origin_m, direction, hit_prior, time_s) -> RenderedRays:
        near = direction[:, 1] > 2e-4  # a post begins a little to the left of the ray's axis
        return RenderedRays(
            np.where(near, 5.0, 20.0).astype(np.float32), np.ones(len(near), np.float32),
            np.where(near, 0.9, 0.05).astype(np.float32), hit_prior,
        )  # fmt: skip

    ahead = np.array([[1.0, 0.0, 0.0]], np.float32)
    columns = (np.zeros((1, 3), np.float32), ahead, np.ones(1, np.float32), np.zeros(1))
    wide = render_beams(render, *columns, divergence_mrad=3.0)
    thin = render_beams(render, *columns, divergence_mrad=0.1)
    assert wide.range_m[0] == 5.0 and wide.hit[0] == pytest.approx(1.0)
    assert wide.intensity[0] == pytest.approx(0.125 * 0.9), "an eighth of the light falls on the post"
    assert thin.range_m[0] == 20.0 and thin.hit[0] == pytest.approx(1.0)
    assert wide.hit_prior is not None and wide.hit_prior.tolist() == [1.0], "who corrects hits asks for it"
