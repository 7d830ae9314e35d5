"""The residual LiDAR field: corrections of the evidence's surfaces, and features decoded once a ray."""

import numpy as np
import torch
from torch import Tensor, nn

from nvsf_core.encodings.hash_grid import HashGrid
from nvsf_core.evidence.moving.object_evidence import ObjectEvidence
from nvsf_core.fields.layers import network
from nvsf_core.fields.surface_batch import SurfaceBatch, object_places
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.kernels.encodings.hash_grid import GridLayout
from nvsf_core.kernels.surface_list import N_FACTS
from nvsf_core.recipe import FieldSpec


def grid_layout(spec: FieldSpec, edge_m: float) -> GridLayout:
    """The hash grid whose cells have the recipe's sizes in a cube of edge `edge_m`."""
    return GridLayout(
        levels=spec.levels,
        features=spec.features,
        log2_table=spec.log2_table,
        base_resolution=max(2, round(edge_m / spec.coarsest_cell_m)),
        finest_resolution=max(4, round(edge_m / spec.finest_cell_m)),
    )


class LidarField(nn.Module):
    """Corrections of each surface's opacity and range, 0 before training: it starts from the evidence."""

    def __init__(self, spec: FieldSpec, bounds: Bounds, generator: torch.Generator) -> None:
        """Sample all weights from `generator`."""
        super().__init__()
        self.spec = spec
        self.bounds = bounds
        layout = grid_layout(spec, bounds.edge_m)
        self.grid = HashGrid(layout, generator)
        self.density = network(
            (layout.outputs + N_FACTS, spec.hidden, 2 + spec.decoded), generator, zero_outputs=2
        )
        self.hit_head = network((spec.decoded + 8, spec.decoder_hidden, 1), generator, zero_outputs=1)
        self.intensity_head = network((spec.decoded + 8, spec.decoder_hidden, 1), generator, zero_outputs=1)

    @classmethod
    def around(cls, points_m: np.ndarray, spec: FieldSpec, generator: torch.Generator) -> "LidarField":
        """An untrained field in the smallest cube around points (n, 3), scene-local metres, with a margin."""
        low_m, high_m = points_m.min(axis=0), points_m.max(axis=0)
        return cls(spec, Bounds.around(tuple(low_m.tolist()), tuple(high_m.tolist())), generator)

    def places(self, objects: tuple[ObjectEvidence, ...]) -> np.ndarray:
        """`object_places` (n, 3) in this field's cube, metres, of a scene's moving objects."""
        paths = tuple(one.path for one in objects)
        return object_places(paths, self.bounds, self.spec.coarsest_cell_m)

    def surfaces(self, batch: SurfaceBatch) -> tuple[Tensor, Tensor, Tensor]:
        """Corrected opacity logit (m,), range_m (m,), and features (m, d) of a batch's m surfaces."""
        encoded = self.grid(self.bounds.to_unit(batch.point_m).clamp_(0.0, 1.0))
        raw = self.density(torch.cat([encoded, batch.facts], dim=1))
        shift_m = self.spec.max_shift_m * torch.tanh(raw[:, 1])
        return batch.logit + raw[:, 0], batch.range_m + shift_m, raw[:, 2:]

    def decode(self, ray: Tensor) -> tuple[Tensor, Tensor]:
        """Corrections of hit logit and intensity logit, (r,) each, from composited features (r, d + 8)."""
        return self.hit_head(ray)[:, 0], self.intensity_head(ray)[:, 0]
