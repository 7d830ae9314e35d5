"""Everything that a scene's training sweeps prove, joined; to and from named arrays for the store."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.moving.dynamic import DynamicEvidence
from nvsf_core.evidence.raydrop.prior import DropPrior
from nvsf_core.evidence.raydrop.stationary_scans import StationaryScans
from nvsf_core.evidence.static.surfels import Surfels

_RENDERED, _UNKNOWN = "rendered_", "unknown_"
_LEFT_OUT, _LEFT_OUT_RENDERED = "left_out_", "left_out_rendered_"


@dataclass(frozen=True, slots=True)
class LeftOutEvidence:
    """What stays, as it is proven without a few training scans that judge what others make of it."""

    validation: np.ndarray
    """(j,) int64: numbers of those scans among the training ones, ascending."""
    static: Surfels
    """In the fields' voxels."""
    rendered: Surfels | None = None
    """Like `SceneEvidence.rendered`; None where that is None."""

    @property
    def for_rendering(self) -> Surfels:
        """Surfels for the renderer that learns nothing."""
        return self.static if self.rendered is None else self.rendered

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Named arrays that `from_arrays` reads back."""
        own = {} if self.rendered is None else _prefixed(_LEFT_OUT_RENDERED, self.rendered)
        return {"left_out_scans": self.validation} | _prefixed(_LEFT_OUT, self.static) | own

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> "LeftOutEvidence | None":
        """Read back what `to_arrays` gave; None where no scan was left out."""
        static = _surfels(_LEFT_OUT, arrays)
        if static is None:
            return None
        return LeftOutEvidence(arrays["left_out_scans"], static, _surfels(_LEFT_OUT_RENDERED, arrays))


@dataclass(frozen=True, slots=True)
class SceneEvidence:
    """One scene's evidence, scene-local metres."""

    surfels: Surfels
    """Of all returns, as if nothing moved."""
    prior: DropPrior
    lasers: np.ndarray
    """(l,) int16: lasers that ever returned, from the top."""
    firings: np.ndarray
    """(n,) int32: firings a turn of each training scan."""
    own_range_m: np.ndarray
    """(lasers, cells) float32: range of the own vehicle by laser and azimuth cell, 0 where it is not."""
    own_intensity: np.ndarray
    """(lasers, cells) float32."""
    dynamic: DynamicEvidence | None = None
    """What moves, and the scene without it; None where nothing was seen to move."""
    stationary: StationaryScans | None = None
    """What was measured where the sensor stood or crawled; None where it never did."""
    rendered: Surfels | None = None
    """Of what stays, with shapes, in voxels of the size that suits the renderer that learns nothing; None =
    `static`."""
    left_out: LeftOutEvidence | None = None
    """For judging what is learned of the scene; None where there are too few scans to leave any out."""
    unobserved: Surfels | None = None
    """Voxels beside static ones that no ray observed: `unobserved_beside`; None where there are none."""

    @property
    def static(self) -> Surfels:
        """Surfels of what stays: all of them where nothing was seen to move."""
        return self.surfels if self.dynamic is None else self.dynamic.static

    @property
    def for_rendering(self) -> Surfels:
        """Surfels of what stays, for the renderer that learns nothing."""
        return self.static if self.rendered is None else self.rendered

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Named arrays that `from_arrays` reads back."""
        moving = {} if self.dynamic is None else self.dynamic.to_arrays()
        stationary = {} if self.stationary is None else self.stationary.to_arrays()
        rendered = {} if self.rendered is None else _prefixed(_RENDERED, self.rendered)
        left_out = {} if self.left_out is None else self.left_out.to_arrays()
        unobserved = {} if self.unobserved is None else _prefixed(_UNKNOWN, self.unobserved)
        return self.surfels.to_arrays() | moving | stationary | rendered | left_out | unobserved | {
            "prior_time_s": self.prior.time_s, "prior_fraction": self.prior.fraction,
            "prior_is_hit": self.prior.is_hit, "lasers": self.lasers, "firings": self.firings,
            "own_range_m": self.own_range_m, "own_intensity": self.own_intensity,
        }  # fmt: skip

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> "SceneEvidence":
        """Read back what `to_arrays` gave."""
        a = arrays
        prior = DropPrior(a["prior_time_s"], a["prior_fraction"], a["prior_is_hit"])
        return SceneEvidence(
            surfels=Surfels.from_arrays(a), prior=prior, lasers=a["lasers"], firings=a["firings"],
            own_range_m=a["own_range_m"], own_intensity=a["own_intensity"],
            dynamic=DynamicEvidence.from_arrays(a), stationary=StationaryScans.from_arrays(a),
            rendered=_surfels(_RENDERED, a), left_out=LeftOutEvidence.from_arrays(a),
            unobserved=_surfels(_UNKNOWN, a),
        )  # fmt: skip


def _prefixed(prefix: str, surfels: Surfels) -> dict[str, np.ndarray]:
    return {prefix + name: value for name, value in surfels.to_arrays().items()}


def _surfels(prefix: str, arrays: dict[str, np.ndarray]) -> Surfels | None:
    """Surfels under names with a prefix; None where they are not all there."""
    if not all(prefix + name in arrays for name in Surfels.ARRAYS):
        return None
    return Surfels.from_arrays({name: arrays[prefix + name] for name in Surfels.ARRAYS})
