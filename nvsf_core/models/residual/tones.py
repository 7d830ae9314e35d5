"""Brings the look of a camera's images to that of another one: exposure and contrast may differ."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nvsf_core.models.residual.shared_images import SharedImages
from nvsf_core.recording.drive import Recording

_QUANTILES = np.linspace(0.02, 0.98, 49)
_LEAST, _MOST = 3.0, 250.0
"""Levels outside are cut off by the sensor."""
_LEAST_USED = 0.5
"""Share of the quantiles that must lie between: by night, a few lamps tell nothing of all the rest."""
_THINNED = 4
"""Quantiles are of one pixel in so many rows and columns."""
_SAME = 3.0
"""Looks that differ by no more levels on the mean are the same: what two cameras see differs as much."""


@dataclass(frozen=True, slots=True)
class ToneCurve:
    """Maps levels x in 0..1 of each colour to gain * x^exponent."""

    gain: tuple[float, ...]
    """Of red, green, blue."""
    exponent: tuple[float, ...]

    def of(self, rgb: np.ndarray) -> np.ndarray:
        """Images (..., 3) uint8 with mapped levels."""
        levels = self._levels()
        return np.stack([levels[k][rgb[..., k]] for k in range(3)], axis=-1)

    def inverse(self) -> "ToneCurve":
        """The curve back."""
        both = zip(self.gain, self.exponent, strict=True)
        gain = tuple(float(gain ** (-1.0 / exponent)) for gain, exponent in both)
        return ToneCurve(gain, tuple(1.0 / exponent for exponent in self.exponent))

    def _levels(self) -> np.ndarray:
        """(3, 256) uint8: what each level of each colour is mapped to."""
        level = np.arange(256) / 255.0
        gain, exponent = np.array(self.gain)[:, None], np.array(self.exponent)[:, None]
        return np.round(255.0 * np.minimum(gain * level**exponent, 1.0)).astype(np.uint8)


def tone_curve(rgb: np.ndarray, like: np.ndarray) -> ToneCurve | None:
    """The curve by which images (n, H, W, 3) uint8 look like those of a camera; None where they do already.

    None, too, where more than half is dark or glares, so that levels do not tell. Fitted to the logarithms of
    the quantiles of all pixels, which need no correspondence: over a drive a pair of cameras sees the same.
    """
    fits, apart = [], []
    for colour in range(3):
        own, other = (
            np.quantile(images[:, ::_THINNED, ::_THINNED, colour], _QUANTILES) for images in (rgb, like)
        )
        used = (np.minimum(own, other) > _LEAST) & (np.maximum(own, other) < _MOST)
        if used.mean() < _LEAST_USED or min(np.ptp(own[used]), np.ptp(other[used])) <= _SAME:
            return None
        exponent, offset = np.polyfit(np.log(own[used] / 255.0), np.log(other[used] / 255.0), 1)
        fits.append((float(np.exp(offset)), float(exponent)))
        apart.append(np.abs(own - other)[used].mean())
    if np.mean(apart) <= _SAME:
        return None
    return ToneCurve(*zip(*fits, strict=True))


def tones_of(recording: Recording, shared: Sequence[SharedImages]) -> dict[str, ToneCurve]:
    """For each camera that looks otherwise than the first of those it shares images with: the curve to it."""
    found = {}
    for one in shared:
        first = recording.cameras[one.name].training.rgb
        for name in one.cameras[1:]:
            curve = tone_curve(recording.cameras[name].training.rgb, first)
            if curve is not None:
                found[name] = curve
    return found


def with_tones(recording: Recording, tones: Mapping[str, ToneCurve]) -> Recording:
    """The drive with the images of the named cameras mapped by their curves."""
    cameras = dict(recording.cameras)
    for name, curve in tones.items():
        training = cameras[name].training
        cameras[name] = replace(cameras[name], training=replace(training, rgb=curve.of(training.rgb)))
    return replace(recording, cameras=cameras)
