"""The cameras' residual field: the LiDAR's surfaces, and beyond its reach samples of its own."""

import torch
from torch import Tensor, nn

from nvsf_core.encodings.hash_grid import HashGrid
from nvsf_core.encodings.spherical_harmonics import spherical_harmonics
from nvsf_core.fields.layers import network, scatter_rows
from nvsf_core.fields.lidar_field import grid_layout
from nvsf_core.fields.surface_batch import N_FACTS, SurfaceBatch
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.recipe import FieldSpec

_HARMONICS = 16
_EMPTY_LOGIT = -2.5
"""Opacity logit of a background sample before anything is learned: mostly air."""


class CameraField(nn.Module):
    """Features of surfaces and of the background, composited along a ray and decoded to a colour once."""

    def __init__(self, spec: FieldSpec, bounds: Bounds, generator: torch.Generator) -> None:
        """Draw all weights from `generator`."""
        super().__init__()
        self.spec = spec
        self.bounds = bounds
        # The cube fills half of the contracted axis, hence twice the edge for the same cell in metres.
        layout = grid_layout(spec, 2.0 * bounds.edge_m)
        self.grid = HashGrid(layout, generator)
        self.surface = network((layout.outputs + N_FACTS, spec.hidden, 1 + spec.decoded), generator, silent=1)
        self.background = network((layout.outputs, spec.hidden, 1 + spec.decoded), generator, silent=1)
        self.sky = network((_HARMONICS, spec.hidden, spec.decoded), generator)
        self.colour_head = network((spec.decoded + 1 + _HARMONICS, spec.decoder_hidden, 3), generator)

    def surfaces(self, batch: SurfaceBatch) -> tuple[Tensor, Tensor]:
        """Opacity logit (r, k) and features (r, k, d) of the proposed surfaces."""
        points = batch.origin_m[:, None] + batch.direction[:, None] * batch.range_m[..., None]
        there = batch.is_there
        encoded = self.grid(self.bounds.to_contracted_unit(points[there]))
        raw = scatter_rows(self.surface(torch.cat([encoded, batch.facts[there]], dim=1)), there)
        return batch.logit + raw[..., 0], raw[..., 1:]

    def beyond(self, batch: SurfaceBatch, range_m: Tensor) -> tuple[Tensor, Tensor]:
        """Opacity logit (r, b) and features (r, b, d) of samples at `range_m` (r, b)."""
        points = batch.origin_m[:, None] + batch.direction[:, None] * range_m[..., None]
        encoded = self.grid(self.bounds.to_contracted_unit(points.reshape(-1, 3)))
        raw = self.background(encoded).reshape(*range_m.shape, -1)
        return _EMPTY_LOGIT + raw[..., 0], raw[..., 1:]

    def colour(self, features: Tensor, left: Tensor, direction: Tensor) -> Tensor:
        """Colour (r, 3) in 0..1 from features (r, d), the light left for the sky (r,), direction (r, 3)."""
        harmonics = spherical_harmonics(direction)
        with_sky = features + left[:, None] * self.sky(harmonics)
        return torch.sigmoid(self.colour_head(torch.cat([with_sky, left[:, None], harmonics], dim=1)))
