"""Renders LiDAR rays, panos and images by the paper's trained field."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from nvsf_core.fields.scene_field import SceneField
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.rendering.rendered import RenderedImage, RenderedRays
from nvsf_core.rendering.scaled_rays import ScaledRays, camera_rays, lidar_rays
from nvsf_core.rendering.volume import VolumeRender, on_white, render_volume
from nvsf_core.sensors.linear_pano import LinearPano

_SAMPLES_AT_ONCE, _SAMPLES_AT_ONCE_ON_CPU = 1 << 20, 1 << 16
"""Samples in memory at once, about a kilobyte each; more would not fit the processor's caches."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperModel:
    """A trained scene, ready to render."""

    recipe: PaperRecipe
    field: SceneField
    bounds: Bounds
    frame_at: Callable[[float], float]
    """Converts seconds since the first frame to the field's frame coordinate."""
    unet: nn.Module | None
    """Corrects the hit probabilities of panos; None if the recipe has none or it is not trained yet."""
    turn_up_rad: float
    """Angle by which the panos' rays are turned up, as in training."""

    def render_rays(
        self, origin_m: np.ndarray, direction: np.ndarray, hit_prior: np.ndarray, time_s: np.ndarray
    ) -> RenderedRays:
        """Render LiDAR rays, all at the mean of their times, because the field takes one time a batch.

        Arguments as of `RayRenderer`.
        """
        frame = self.frame_at(float(time_s.mean())) if len(time_s) else 0.0
        range_m, intensity, hit = self._lidar(origin_m, direction, frame)
        return RenderedRays(range_m=range_m.numpy(), hit=hit.numpy(), intensity=intensity.numpy())

    def render_pano(
        self, pose: np.ndarray, time_s: float, *, column_step: int = 1
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Render a pano's own rays, of every `column_step`-th column: range (m), intensity, hit probability.

        Each is (h, w); the pose (4, 4) is LiDAR to scene-local.
        """
        image = self.raw_pano(pose, self.frame_at(time_s), column_step)
        range_m, intensity, hit = image[2] * self.bounds.half_m, image[1], image[0]
        if self.unet is not None:
            hit = self._refined(image, max(1, self.recipe.refinement.column_step // column_step))
        return range_m.numpy(), intensity.numpy(), hit.numpy()

    def raw_pano(self, pose: np.ndarray, frame: float, column_step: int = 1) -> Tensor:
        """The U-Net's input (3, h, w): hit probability, intensity, range in scaled units."""
        direction = LinearPano().directions(self.turn_up_rad)[:, ::column_step] @ pose[:3, :3].T
        origin = np.broadcast_to(pose[:3, 3], direction.shape)
        found = self._lidar(origin.reshape(-1, 3), direction.reshape(-1, 3), frame)
        range_m, intensity, hit = (values.reshape(direction.shape[:2]) for values in found)
        return torch.stack([hit, intensity, range_m / self.bounds.half_m])

    def render_image(
        self, camera: str, pinhole: Pinhole, pose: np.ndarray, time_s: float, near_s: float | None = None
    ) -> RenderedImage:
        """Render a camera; ranges are ray lengths in metres.

        Args:
            camera: Its name.
            pinhole: Its intrinsics.
            pose: (4, 4) camera to scene-local frame.
            time_s: Instant that the field is asked for.
            near_s: Not used: the field knows no recorded scans.
        """
        direction = (pinhole.rays(pinhole.pixels()) @ pose[:3, :3].T).reshape(-1, 3)
        origin = np.broadcast_to(pose[:3, 3], direction.shape)
        rays = camera_rays(self.bounds, origin, direction, near_m=self.recipe.sampling.near_m)
        frame = self.frame_at(time_s)
        found = self._in_parts(
            rays,
            lambda x01: self.field.density(x01, frame, "camera"),
            self.field.camera,
            lambda render: torch.cat([render.range_scaled[:, None], on_white(render)], dim=1),
        ).reshape(pinhole.height, pinhole.width, 4)
        image = (found[..., 1:].clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
        return RenderedImage(image.numpy(), (found[..., 0] * self.bounds.half_m).numpy())

    def _lidar(
        self, origin_m: np.ndarray, direction: np.ndarray, frame: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Range in metres, intensity and hit probability (r,) of LiDAR rays (r, 3), scene-local."""
        spec = self.recipe.sampling
        rays = lidar_rays(self.bounds, origin_m, direction, near_m=spec.near_m, far_m=spec.far_m)
        found = self._in_parts(
            rays,
            lambda x01: self.field.density(x01, frame, "lidar"),
            self.field.lidar,
            lambda render: torch.cat([render.range_scaled[:, None], render.attributes], dim=1),
        )
        return found[:, 0] * self.bounds.half_m, found[:, 1], found[:, 2].clamp(0.0, 1.0)

    @torch.no_grad()
    def _in_parts(
        self,
        rays: ScaledRays,
        density: Callable[[Tensor], tuple[Tensor, Tensor]],
        attributes: Callable[[Tensor, Tensor], Tensor],
        result: Callable[[VolumeRender], Tensor],
    ) -> Tensor:
        """Volume-render rays in parts of bounded memory; returns `result` of all rays (r, c) on the CPU."""
        device = next(self.field.parameters()).device
        samples = self.recipe.sampling.samples
        most = _SAMPLES_AT_ONCE_ON_CPU if device.type == "cpu" else _SAMPLES_AT_ONCE
        at_once = max(1, most // samples)
        parts = []
        for first in range(0, max(1, len(rays)), at_once):
            render = render_volume(
                density,
                attributes,
                rays.part(slice(first, first + at_once)).to(device),
                samples=samples,
                bound=self.bounds.bound,
            )
            parts.append(result(render).cpu())
        return torch.cat(parts)

    @torch.no_grad()
    def _refined(self, image: Tensor, phases: int) -> Tensor:
        """The U-Net's hit probability (h, w), by `phases` images of every `phases`-th column (as trained)."""
        assert self.unet is not None
        device = next(self.unet.parameters()).device
        self.unet.eval()
        hit = torch.empty_like(image[0])
        for phase in range(phases):
            part = image[None, :, :, phase::phases].to(device)
            hit[:, phase::phases] = torch.sigmoid(self.unet(part))[0].cpu()
        return hit
