"""The baseline `mesh`: a Poisson mesh of the returns, and rays cast against it (open3d)."""

from dataclasses import replace

import numpy as np

from nvsf_core.clouds.mesh import Mesh, MeshRays, mesh_rays
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recording.drive import Recording
from nvsf_core.rendering.rendered import RenderedImage, RenderedRays
from nvsf_core.rendering.reproject import NEAR_M
from nvsf_core.rendering.reproject_camera import render_by_warping
from nvsf_core.simulation.scene_model import ImageRenderer, RayRenderer, SceneModel


def mesh_baseline(mesh: Mesh | None, recording: Recording) -> SceneModel | None:
    """The baseline of a scene; None if the stage `mesh` made no mesh (its record says why).

    Raises:
        MissingLibraryError: The mesh was made elsewhere and open3d cannot be loaded here.
    """
    if mesh is None or recording.lidar is None:
        return None
    cast = mesh_rays(mesh)
    return SceneModel(
        lidar=_lidar(cast, recording.lidar.far_m),
        camera=_camera(cast, recording) if recording.cameras else None,
    )


def _lidar(cast: MeshRays, far_m: float) -> RayRenderer:
    """Range from the mesh, hit probability from `hit_prior`; the mesh does not move."""

    def render(
        origin_m: np.ndarray, direction: np.ndarray, hit_prior: np.ndarray, time_s: np.ndarray
    ) -> RenderedRays:
        del time_s
        range_m, intensity = cast(origin_m + NEAR_M * direction, direction)
        range_m = range_m + np.float32(NEAR_M)
        met = range_m < far_m
        return RenderedRays(
            range_m=np.where(met, range_m, np.inf).astype(np.float32),
            hit=np.where(met, hit_prior, 0.0).astype(np.float32),
            intensity=np.where(met, intensity, 0.0).astype(np.float32),
        )

    return render


def _camera(cast: MeshRays, recording: Recording) -> ImageRenderer:
    """The two nearest training images, warped by the mesh's depth and averaged; without a plane sweep."""

    def warp(
        camera: str, pinhole: Pinhole, pose: np.ndarray, time_s: float, near_s: float | None = None
    ) -> RenderedImage:
        del time_s, near_s
        images = recording.cameras[camera].training
        direction = (pinhole.rays(pinhole.pixels()).reshape(-1, 3) @ pose[:3, :3].T).astype(np.float32)
        origin_m = np.broadcast_to(pose[:3, 3].astype(np.float32), direction.shape)
        range_m, _ = cast(origin_m, direction)
        met = np.isfinite(range_m)
        points_m = origin_m[met] + direction[met] * range_m[met, None]
        view = render_by_warping(
            pose, pinhole, points_m, images.rgb, images.pose, source_valid=images.valid, sweep=False
        )
        return replace(view, range_m=range_m.reshape(pinhole.height, pinhole.width))

    return warp
