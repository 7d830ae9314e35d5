"""When a spinning sensor looks where: which way it spins, and at which azimuth its sweeps are cut.

Grids of lasers and firings are ordered by azimuth, from behind and clockwise, whatever the sensor does; a
sensor's clock tells when in the sweep each of their columns was fired.
"""

from typing import NamedTuple

import numpy as np

_LEAST_CONCENTRATION = 0.9
"""Least length of the mean of unit vectors: of returns whose times follow their azimuths it is nearly 1."""


class SweepClock(NamedTuple):
    """Times of a sweep's azimuths; as it stands, of a sensor that spins clockwise and is cut behind."""

    spin: float = 1.0
    """1 = clockwise seen from above, -1 = counter-clockwise."""
    cut: float = -0.5
    """Where a sweep begins, -0.5..0.5: `spin` times the `sweep_fraction` of that azimuth."""
    lag: float = 0.0
    """Sweeps after the pose's instant at which the sensor, had it begun behind, would look ahead."""

    @classmethod
    def stored(cls, clocks: np.ndarray | None, row: int) -> "SweepClock":
        """That of a scan in `sweep_clock` (n, 3) of the data contract; None = the usual one."""
        return cls() if clocks is None else cls(*clocks[row].tolist())

    def elapsed(self, fraction: np.ndarray) -> np.ndarray:
        """Sweeps after the pose's instant (...) at which azimuths of `sweep_fraction` (...) are measured."""
        turned = fraction if self.spin > 0.0 else -fraction
        return turned + self.lag + (turned < self.cut)


def find_clock(fraction: np.ndarray, elapsed: np.ndarray) -> SweepClock | None:
    """The clock of a scan by its returns' `sweep_fraction` (N,) and recorded times (N,), in sweeps.

    None where these do not follow the azimuths.
    """
    if len(fraction) == 0:
        return None
    # Elapsed time less turned angle is the same for all returns but for whole sweeps, which a mean on the
    # circle does not see.
    phases = {spin: np.exp(2j * np.pi * (elapsed - spin * fraction)).mean() for spin in (1.0, -1.0)}
    spin, phase = max(phases.items(), key=lambda one: abs(one[1]))
    if abs(phase) < _LEAST_CONCENTRATION:
        return None
    turned = spin * fraction
    lag = float(np.angle(phase) / (2.0 * np.pi))
    sweeps = np.rint(elapsed - turned - lag)
    values, count = np.unique(sweeps, return_counts=True)
    # Returns before the cut are a whole sweep later than those behind it: of all pairs of neighbouring
    # numbers, the one that most returns have.
    pairs = {value: int(count[(values == value) | (values == value + 1.0)].sum()) for value in values}
    begun = max(pairs, key=lambda value: pairs[value])
    return SweepClock(spin, _cut(turned, sweeps > begun), lag + float(begun))


def sweep_duration_s(fraction: np.ndarray, offset_s: np.ndarray, step_s: float) -> float | None:
    """Duration of a sweep by its returns' recorded times; None where these do not follow the azimuth.

    Where the times fit a sweep that lasts as long as the step between frames, that is the answer: it is the
    better measured one. Of key frames, which are farther apart, the times' own span is tried.

    Args:
        fraction: (N,) `sweep_fraction` of the returns' azimuths, -0.5..0.5.
        offset_s: (N,) seconds after the frame's time, as recorded.
        step_s: From frame to frame, above 0.
    """
    if len(fraction) == 0:
        return None
    if find_clock(fraction, offset_s / step_s) is not None:
        return step_s
    span_s = float(np.ptp(np.percentile(offset_s, [0.5, 99.5]))) / 0.99
    clock = find_clock(fraction, offset_s / span_s) if span_s > 0.0 else None
    if clock is None:
        return None
    # Some lasers look aside of the sensor's azimuth: their returns lie beyond the cut, where the times say
    # which sweep they are of, and it is the azimuth that has the error, so that it is fitted to the times.
    turned = clock.spin * fraction + clock.lag
    turned += np.rint(offset_s / span_s - turned)
    return 1.0 / float(np.polyfit(offset_s, turned, 1)[0])


def _cut(turned: np.ndarray, is_later: np.ndarray) -> float:
    """The value of `turned` (N,) below which returns are later, with the fewest exceptions."""
    order = np.argsort(turned)
    right = np.concatenate([[0], np.cumsum(np.where(is_later[order], 1, -1))])
    best = int(right.argmax())
    if best == 0:
        return -0.5
    if best == len(turned):
        return 0.5
    return float(turned[order[best - 1 : best + 1]].mean())
