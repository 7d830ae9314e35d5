"""The demo's cameras: their calibration, and their images, rendered with one ray a pixel."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.demo.shapes import tile_index
from nvsf_core.demo.street import Material
from nvsf_core.demo.world import HORIZON_M, DemoHits, DemoWorld
from nvsf_core.drives.kitti360.writer import RectifiedCamera
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import exp_so3, invert_pose, pose_from_parts

BASELINE_M = 0.6
"""From camera 0 to camera 1, to the right."""
LIDAR_TO_POSE = pose_from_parts(
    np.diag([1.0, -1.0, -1.0]) @ exp_so3(np.array([0.004, -0.003, 0.006])), np.array([0.77, 0.26, -0.8])
)
"""(4, 4); the pose frame has x forward, y right, z down."""
_CAMERA_AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Rotation from a level camera's frame (x right, y down, z forward) to the pose frame."""
_RECTIFICATIONS = {
    "image_00": exp_so3(np.array([-0.003, 0.0002, -0.007])),
    "image_01": exp_so3(np.array([0.003, 0.017, 0.012])),
}
_FISHEYE = "image_02"
_SUN = np.array([0.45, 0.35, 0.82], np.float32)
_SKY_LOW = np.array([0.83, 0.87, 0.9], np.float32)
_SKY_HIGH = np.array([0.38, 0.56, 0.83], np.float32)
_ALBEDO = {
    Material.SKY: (0.0, 0.0, 0.0), Material.ASPHALT: (0.33, 0.33, 0.34), Material.MARKING: (0.88, 0.88, 0.85),
    Material.PAVEMENT: (0.58, 0.56, 0.53), Material.KERB: (0.5, 0.49, 0.47),
    Material.PLASTER: (0.8, 0.75, 0.66), Material.GLASS: (0.16, 0.2, 0.25),
    Material.BARK: (0.36, 0.27, 0.2), Material.LEAF: (0.3, 0.47, 0.2),
    Material.METAL: (0.45, 0.47, 0.48), Material.SIGN: (0.8, 0.12, 0.12), Material.PAINT: (0.6, 0.6, 0.62),
    Material.RUBBER: (0.1, 0.1, 0.1), Material.CLOTH: (0.2, 0.3, 0.62),
}  # fmt: skip
_TINT = {Material.PLASTER: 0.22, Material.PAINT: 0.7, Material.LEAF: 0.25, Material.CLOTH: 0.3}
"""By how much the colours of single objects differ from their material's."""


@dataclass(frozen=True, slots=True, eq=False)
class DemoCamera:
    """One camera: its model, mounting and rays."""

    name: str
    """`image_00` and so on."""
    model: RectifiedCamera | MeiFisheye
    """As in its calibration file."""
    image_to_pose: np.ndarray
    """(4, 4) camera to pose frame, of the stored image (rectified if perspective)."""
    camera_to_pose: np.ndarray
    """(4, 4) unrectified camera to pose frame, as in `calib_cam_to_pose.txt`."""
    directions: np.ndarray
    """(H W, 3) unit, camera frame, row-major; straight ahead for pixels outside the lens's image."""
    seen: np.ndarray
    """(H W,) bool: the pixel lies in the lens's image."""


def demo_perspective(name: str, width: int, height: int) -> DemoCamera:
    """`image_00` or `image_01`: rectified, 104 degrees across, looking 5 degrees down from 1.55 m."""
    focal, cx, cy = 0.3925 * width, 0.4841 * width, 0.632 * height
    v, u = np.divmod(np.arange(width * height, dtype=np.float64), width)
    directions = np.stack([(u - cx) / focal, (v - cy) / focal, np.ones_like(u)], axis=-1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    baseline = BASELINE_M if name == "image_01" else 0.0
    rotation = _CAMERA_AXES @ exp_so3(np.array([-0.09, 0.01, 0.003]))
    position = np.array([1.57, -0.04, -0.62]) + rotation @ (baseline, 0.0, 0.0)
    image_to_pose = pose_from_parts(rotation, position)
    rectification = _RECTIFICATIONS[name]
    model = RectifiedCamera(Pinhole(focal, focal, cx, cy, width, height), baseline, rectification)
    camera_to_pose = image_to_pose @ pose_from_parts(rectification, np.zeros(3))
    return DemoCamera(name, model, image_to_pose, camera_to_pose, directions, np.ones(len(u), bool))


def demo_fisheye(name: str, side: int) -> DemoCamera:
    """`image_02`: a fisheye on the roof that looks to the left, 180 degrees and a little more."""
    model = MeiFisheye(
        xi=2.21, k1=0.017, k2=1.65, p1=4e-4, p2=4e-4, gamma1=0.954 * side, gamma2=0.954 * side,
        u0=0.511 * side, v0=0.504 * side, width=side, height=side,
    )  # fmt: skip
    v, u = np.divmod(np.arange(side * side, dtype=np.float64), side)
    directions, solved = model.unproject(np.stack([u, v], axis=-1))
    seen = solved & np.isfinite(directions).all(axis=-1)
    directions = np.where(seen[:, None], directions, (0.0, 0.0, 1.0))
    axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    pose = pose_from_parts(axes @ exp_so3(np.array([0.01, 0.02, -0.005])), np.array([0.73, -0.15, -1.07]))
    return DemoCamera(name, model, pose, pose, directions, seen)


def demo_camera(name: str, width: int, height: int) -> DemoCamera:
    """The writer's camera of that name, with images of that size: a fisheye if it is `image_02`."""
    return demo_fisheye(name, height) if name == _FISHEYE else demo_perspective(name, width, height)


def render_image(
    world: DemoWorld,
    camera: DemoCamera,
    time_s: float,
    mount: np.ndarray | None = None,
    *,
    path_to_world: np.ndarray | None = None,
) -> np.ndarray:
    """Image (H, W, 3) uint8, red first, without noise; black outside the lens's image.

    Args:
        world: The street.
        camera: One of its cameras.
        time_s: When it is taken, seconds since the first frame.
        mount: (4, 4) pose of the LiDAR, with which the cameras move, in the path's frame; None = the same.
        path_to_world: (4, 4) pose of the path; None = of the recording car's LiDAR at that time.
    """
    if path_to_world is None:
        lidar = world.lidar_to_street(np.array([time_s]))[0]
    else:
        lidar = world.world_to_street @ path_to_world
    lidar = lidar if mount is None else lidar @ mount
    pose = lidar @ invert_pose(LIDAR_TO_POSE) @ camera.image_to_pose
    directions = (camera.directions @ pose[:3, :3].T).astype(np.float32)
    origins = np.broadcast_to(pose[:3, 3].astype(np.float32), directions.shape)
    model = camera.model.pinhole if isinstance(camera.model, RectifiedCamera) else camera.model
    height, width = model.height, model.width
    tiles = tile_index(height, width, 8)
    hits = world.cast_in_street(origins, directions, np.full(len(directions), time_s), tiles)
    rgb = _shade(hits, directions) * camera.seen[:, None]
    return np.round(np.clip(rgb, 0.0, 1.0) * 255.0).astype(np.uint8).reshape(height, width, 3)


def _shade(hits: DemoHits, directions: np.ndarray) -> np.ndarray:
    """Colours (N, 3) in 0..1 of hits along `directions` (N, 3).

    Light of sun and sky on a patterned surface, the sky mirrored by glass and paint, and haze.
    """
    albedo = np.array([_ALBEDO[kind] for kind in Material], np.float32)[hits.material]
    tint = np.array([_TINT.get(kind, 0.0) for kind in Material], np.float32)[hits.material]
    phase = hits.instance[:, None] * np.array([0.37, 0.71, 1.13], np.float32)
    albedo = albedo * (1.0 + 0.5 * tint[:, None] * np.sin(5.0 * phase))
    albedo *= (1.0 + _pattern(hits))[:, None]

    sun = np.maximum(hits.normal @ (_SUN / np.linalg.norm(_SUN)), 0.0)
    light = 0.42 + 0.12 * hits.normal[:, 2] + 0.55 * sun
    colour = albedo * light[:, None]

    cosine = np.abs((hits.normal * directions).sum(axis=1))
    shiny = np.isin(hits.material, (Material.GLASS, Material.PAINT))
    mirror = np.where(shiny, 0.08 + 0.6 * (1.0 - cosine) ** 4, 0.0).astype(np.float32)[:, None]
    reflected = directions[:, 2] - 2.0 * (hits.normal * directions).sum(axis=1) * hits.normal[:, 2]
    colour = (1.0 - mirror) * colour + mirror * _sky(reflected)

    far = np.isfinite(hits.range_m)
    haze = 1.0 - np.exp(-np.where(far, hits.range_m, HORIZON_M) / np.float32(350.0))
    haze = np.where(far, haze, 1.0)[:, None]
    return (1.0 - haze) * colour + haze * _sky(directions[:, 2])


def _sky(up: np.ndarray) -> np.ndarray:
    """Colour (N, 3) of the sky towards directions whose z is `up` (N,)."""
    height = np.sqrt(np.clip(up, 0.0, 1.0))[:, None]
    return (1.0 - height) * _SKY_LOW + height * _SKY_HIGH


def _pattern(hits: DemoHits) -> np.ndarray:
    """Relative brightness (N,) of the surface's texture: stains, courses on walls, slabs on pavements."""
    x, y, z = (hits.local_m[:, axis] for axis in range(3))
    stains = np.sin(2.1 * x + 1.3 * np.sin(1.7 * y)) * np.sin(1.9 * y + 2.3 * z + 0.7 * np.sin(2.9 * x))
    grain = np.sin(9.0 * x + 4.0 * z) * np.sin(8.0 * y - 5.0 * z + 2.0 * np.sin(3.0 * x))
    pattern = 0.07 * stains + 0.06 * grain
    courses = (np.mod(z + 50.0, 0.6) < 0.06) | (np.mod(x + 50.0 + 0.6 * np.floor(z / 0.6), 1.2) < 0.05)
    pattern -= np.where((hits.material == Material.PLASTER) & courses, 0.16, 0.0)
    slabs = (np.mod(x, 0.75) < 0.04) | (np.mod(y, 0.75) < 0.04)
    pattern -= np.where((hits.material == Material.PAVEMENT) & slabs, 0.15, 0.0)
    near = np.exp(-np.where(np.isfinite(hits.range_m), hits.range_m, HORIZON_M) / 40.0)
    # Far away the texture is finer than a pixel, which one ray cannot average: it is faded out.
    return pattern * near
