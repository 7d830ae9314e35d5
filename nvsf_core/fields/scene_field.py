"""The joined field of the paper's Fig. 2: f_lidar(x, θ) = (σ, i, p) and f_camera(x, θ) = (σ, c), Sec. III."""

from typing import Any, Literal, cast

import torch
from torch import Tensor, nn

from nvsf_core.encodings.directions import SPHERICAL_HARMONICS_OUTPUTS, frequency_encode, spherical_harmonics
from nvsf_core.encodings.hybrid import HybridEncoding
from nvsf_core.errors import RecipeError
from nvsf_core.fields.flow import FlowField, applied
from nvsf_core.fields.layers import Density, Head
from nvsf_core.kernels.encodings.hash_grid import start_alike
from nvsf_core.recipe.paper import PaperOptimiser, PaperRecipe

Moved = tuple[Tensor, float]
"""Points (n, 3) of the unit cube, moved to another frame, and that frame's time t."""


class SceneField(nn.Module):
    """Encodings, flow, density and heads. A batch has one time: frame i of n, from 0, or between two.

    Strategies of Sec. III-C: `same`: one encoding; `separate`: one a sensor; `separate_fused`: both encodings
    of every point, the sensor's own first, concatenated and fused by the density network's first layer.
    """

    def __init__(self, recipe: PaperRecipe, frames: int, generator: torch.Generator) -> None:
        """Sample all weights; without camera rays there is neither a camera encoding nor a colour head."""
        super().__init__()
        self.recipe, self.frames = recipe, frames
        sensors = 2 if recipe.sampling.camera and recipe.encoders != "same" else 1
        encoders = [HybridEncoding(recipe.encoder, generator) for _ in range(sensors)]
        self.encoders = nn.ModuleList(encoders)
        self.flow = FlowField(recipe.flow, generator)
        self.read = sensors if recipe.encoders == "separate_fused" else 1
        self.density_network = Density(self.read * sum(encoders[0].outputs), recipe.heads, generator)
        angles, harmonics = 6 * recipe.heads.lidar_frequencies, SPHERICAL_HARMONICS_OUTPUTS
        self.intensity = Head(angles, 1, recipe.heads, generator)
        self.hit = Head(angles, 1, recipe.heads, generator)
        self.colour = Head(harmonics, 3, recipe.heads, generator) if recipe.sampling.camera else None
        if recipe.slips.identical_tables:
            start_alike(self)

    def density(self, x01: Tensor, frame: float, sensor: Literal["lidar", "camera"]) -> tuple[Tensor, Tensor]:
        """σ (n,) per scaled unit and geometry features (n, g) of points (n, 3) in the unit cube."""
        moved = self.neighbours(x01, frame) if self.recipe.aggregate and self.frames > 1 else []
        own_first = cast(list[HybridEncoding], list(self.encoders))[:: -1 if sensor == "camera" else 1]
        features = [self._encode(encoder, x01, frame, moved) for encoder in own_first[: self.read]]
        return self.density_network(torch.cat(features, dim=1))

    def neighbours(self, x01: Tensor, frame: float) -> list[Moved]:
        """Unit-cube points (n, 3), moved by MLP_flow (eq. 5) to frames i + 1 and i - 1, where these exist."""
        flows = zip((1, -1), self.flow(x01, self.time(frame)), strict=True)
        there = [(step, flow) for step, flow in flows if 0 <= frame + step <= self.frames - 1]
        return [(x01 + applied(flow, self.recipe.slips), self.time(frame, step)) for step, flow in there]

    def time(self, frame: float, step: int = 0) -> float:
        """Time t = i / (n - 1) in 0..1; with `slips.neighbour_times` a neighbour's is (i ± 1) / n."""
        slip = step != 0 and self.recipe.slips.neighbour_times
        return (frame + step) / (self.frames if slip else max(self.frames - 1, 1))

    def _encode(self, encoder: HybridEncoding, x01: Tensor, frame: float, moved: list[Moved]) -> Tensor:
        """Static features and d = 0.5 d_0 + 0.25 (d_1 + d_-1); a missing frame's d is replaced by d_0."""
        dynamic = (1.0 - 0.25 * len(moved)) * encoder.dynamic(x01, self.time(frame))
        for there, t in moved:
            dynamic = torch.add(dynamic, encoder.dynamic(there, t, hash_gradient=False), alpha=0.25)
        return torch.cat([encoder.static(x01), dynamic], dim=1)

    def lidar(self, direction: Tensor, geometry: Tensor) -> Tensor:
        """Intensity i and hit probability p, (n, 2) in 0..1, of unit directions (n, 3) and geometry features.

        Directions are encoded by frequency, mapped to 0..1 before.
        """
        angles = frequency_encode(0.5 * (direction + 1.0), self.recipe.heads.lidar_frequencies)
        return torch.cat([self.intensity(angles, geometry), self.hit(angles, geometry)], dim=-1)

    def camera(self, direction: Tensor, geometry: Tensor) -> Tensor:
        """Colour c, (n, 3) in 0..1, of unit directions (n, 3) and geometry features (n, g).

        Raises:
            RecipeError: The recipe trains no camera.
        """
        if self.colour is None:
            raise RecipeError(f"{self.recipe.name}: no colour without camera rays; set sampling.camera")
        return self.colour(spherical_harmonics(direction), geometry)

    def parameter_groups(self, optimiser: PaperOptimiser) -> list[dict[str, Any]]:
        """Adam's groups: flow with `flow_rate`, intensity and hit with `head_rate`, the rest `table_rate`."""
        heads, flow = [*self.intensity.parameters(), *self.hit.parameters()], [*self.flow.parameters()]
        tables = [p for p in self.parameters() if not any(p is other for other in heads + flow)]
        rates = (optimiser.table_rate, optimiser.head_rate, optimiser.flow_rate)
        return [{"params": p, "lr": rate} for p, rate in zip((tables, heads, flow), rates, strict=True)]
