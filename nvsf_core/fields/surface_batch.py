"""Rays with the surfaces that evidence proposes for them: what both fields start from."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nvsf_core.evidence.surfels import Surfels, candidates_of
from nvsf_core.fields.object_surfaces import ObjectSurfaces

N_FACTS = 6
_LOGIT_LIMIT = 6.0


@dataclass(frozen=True, slots=True)
class OnObjects:
    """Which of a batch's surfaces are moving objects', and what differs there."""

    mask: Tensor
    """(r, k) bool, with q surfaces."""
    place_m: Tensor
    """(q, 3): where the field's corrections of them lie in its cube."""
    vote: Tensor
    """(r, k): share of the object's nearest scans that returned there, 0 on what stands."""


@dataclass(frozen=True, slots=True)
class SurfaceBatch:
    """r rays with at most k proposed surfaces each, scene-local metres."""

    origin_m: Tensor
    """(r, 3)."""
    direction: Tensor
    """(r, 3)."""
    range_m: Tensor
    """(r, k), ascending; 0 where there is no surface."""
    logit: Tensor
    """(r, k): logit of the evidence's opacity."""
    is_there: Tensor
    """(r, k) bool."""
    facts: Tensor
    """(r, k, 6): opacity logit, cosine of incidence, planar?, log hits, intensity, range; about 0..1."""
    objects: OnObjects | None = None
    """None where no ray meets anything that moves."""

    @property
    def intensity(self) -> Tensor:
        """(r, k): the voxels' mean intensity."""
        return self.facts[..., 4]

    @property
    def cosine(self) -> Tensor:
        """(r, k): cosine of incidence."""
        return self.facts[..., 1]


def surface_batch(
    surfels: Surfels,
    origin_m: np.ndarray,
    direction: np.ndarray,
    *,
    most: int,
    near_m: float,
    far_m: float,
    objects: ObjectSurfaces | None = None,
) -> SurfaceBatch:
    """Walk rays (r, 3) through the evidence of what stands; `objects` of the same rays are merged by range.

    Where there are more than `most` surfaces the farthest are left out.
    """
    found = candidates_of(surfels, origin_m, direction, most=most, near_m=near_m, far_m=far_m)
    depth = max(1, int((found.voxel >= 0).sum(axis=1).max(initial=1)))
    voxel = found.voxel[:, :depth]
    columns = _Columns(
        is_there=voxel >= 0,
        range_m=np.ascontiguousarray(found.range_m[:, :depth]),
        opacity=found.opacity[:, :depth],
        cosine=found.cosine[:, :depth],
        is_planar=surfels.is_planar[voxel],
        hits=surfels.hits[voxel],
        intensity=surfels.intensity[voxel],
    )
    merged = None
    if objects is not None and len(objects.ray) > 0:
        columns, merged = _merge(columns, objects, most)
    logit, facts = _facts(columns)
    return SurfaceBatch(
        origin_m=torch.from_numpy(np.ascontiguousarray(origin_m, np.float32)),
        direction=torch.from_numpy(np.ascontiguousarray(direction, np.float32)),
        range_m=torch.from_numpy(columns.range_m),
        logit=torch.from_numpy(logit.astype(np.float32)),
        is_there=torch.from_numpy(columns.is_there),
        facts=torch.from_numpy(facts.astype(np.float32)),
        objects=merged,
    )


class _Columns(NamedTuple):
    """What is known of r rays' surfaces, (r, k) each."""

    is_there: np.ndarray
    range_m: np.ndarray
    opacity: np.ndarray
    cosine: np.ndarray
    is_planar: np.ndarray
    hits: np.ndarray
    intensity: np.ndarray


def _facts(columns: _Columns) -> tuple[np.ndarray, np.ndarray]:
    """Opacity logits (r, k) and the facts (r, k, 6) that the field is told of each surface."""
    clipped = np.clip(columns.opacity, 1e-6, 1 - 1e-6)
    logit = np.clip(np.log(clipped / (1 - clipped)), -_LOGIT_LIMIT, _LOGIT_LIMIT)
    facts = [
        logit / _LOGIT_LIMIT,
        columns.cosine,
        columns.is_planar,
        np.log1p(columns.hits) / 5.0,
        columns.intensity,
        columns.range_m / 50.0,
    ]
    return logit, np.stack(facts, axis=-1)


def _merge(standing: _Columns, objects: ObjectSurfaces, most: int) -> tuple[_Columns, OnObjects]:
    """Objects' surfaces among those that stand, in order along each ray; at most `most`."""
    index = objects.dense()
    rows, there = objects.ray, index >= 0
    rays, depth = standing.is_there.shape
    width = min(most, depth + index.shape[1])
    own = _Columns(there, *(getattr(objects, name)[index] for name in _Columns._fields[1:]))
    either = np.concatenate([standing.is_there[rows], there], axis=1)
    ranges = np.concatenate([standing.range_m[rows], own.range_m], axis=1)
    order = np.argsort(np.where(either, ranges, np.inf), axis=1, kind="stable")[:, :width]
    columns = []
    for before, mine in zip(standing, own, strict=True):
        column = np.zeros((rays, width), before.dtype)
        column[:, :depth] = before[:, :width]
        both = np.concatenate([before[rows], mine.astype(before.dtype)], axis=1)
        column[rows] = np.take_along_axis(both, order, axis=1)
        columns.append(column)
    source = np.full((rays, width), -1, np.int64)
    none = np.full((len(rows), depth), -1, np.int64)
    source[rows] = np.take_along_axis(np.concatenate([none, index], axis=1), order, axis=1)
    merged = _Columns(*columns)
    merged.range_m[~merged.is_there] = 0.0
    mask = source >= 0
    return merged, OnObjects(
        mask=torch.from_numpy(mask),
        place_m=torch.from_numpy(objects.place_m[source[mask]]),
        vote=torch.from_numpy(np.where(mask, objects.vote[source], np.float32(0.0))),
    )
