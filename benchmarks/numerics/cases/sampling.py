"""Drawing cells, pixels and patches from weights that are all zero, one-hot, huge or broken."""

import math

import numpy as np
import torch

from benchmarks.numerics.cases.case import Case, Reading, refused
from nvsf_core.errors import DivergedError, ShapeError
from nvsf_core.sampling.error_map import ErrorMap
from nvsf_core.sampling.patches import patch_pixels, uniform_corners
from nvsf_core.sampling.pixels import uniform_pixels

TITLE = "Sampling"
_HEIGHT, _WIDTH = 66, 1030


def _map(fill: float = 1.0) -> ErrorMap:
    made = ErrorMap(1, _HEIGHT, _WIDTH, 2)
    made.errors.fill_(fill)
    return made


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def _one_hot() -> Reading:
    """All weight in the last cell, more draws than cells: only its pixels, all within the image."""
    made = _map(0.0)
    made.errors[0, -1, -1] = 1.0
    rows, columns = made.sample_pixels(0, 500, _generator())
    inside = set(zip(rows.tolist(), columns.tolist(), strict=True))
    right = inside <= {(r, c) for r in (64, 65) for c in (1028, 1029)}
    return Reading(outcome=f"{len(rows)} draws of {sorted(inside)}", is_refuted=not right)


def _shares(ratio: float) -> Reading:
    """Half of the cells weigh more by some ratio: their share of single draws, against the exact one."""
    made = ErrorMap(1, 8, 8, 2)
    made.errors[0, :2] = ratio
    generator = _generator()
    draws = [int(made.sample_pixels(0, 1, generator)[0][0]) < 4 for _ in range(4000)]
    expected = ratio / (1.0 + ratio)
    spread = math.sqrt(max(expected * (1.0 - expected), 1e-4) / len(draws))
    return Reading(error=abs(float(np.mean(draws)) - expected), limit=4.0 * spread, unit="share")


def _tiny_and_huge() -> Reading:
    """Weights of 1e-30 beside 1e30: finite, within the image, and the heavy ones first."""
    made = _map(1e-30)
    made.errors[0, 0, :10] = 1e30
    rows, columns = made.sample_pixels(0, 10, _generator())
    heavy = bool(((rows < 2) & (columns < 20)).all())
    return Reading(outcome=f"ten draws all from the ten heavy cells: {heavy}", is_refuted=not heavy)


def _broken(value: float) -> Reading:
    made = _map()
    made.errors[0, 3, 3] = value
    return refused(DivergedError, lambda: made.sample_pixels(0, 10, _generator()))


def _all_zero() -> Reading:
    return refused(DivergedError, lambda: _map(0.0).sample_pixels(0, 10, _generator()))


def _update() -> Reading:
    """Errors from equal to 3e38 keep the map within 0.1 .. 1000, whatever their scale."""
    low, high = math.inf, 0.0
    for scale in (0.0, 1e-45, 1e-30, 1.0, 1e30, 3e38):
        made = _map()
        rows, columns = torch.arange(60), torch.arange(60)
        made.update(0, rows, columns, scale * torch.linspace(-1.0, 1.0, 60))
        low, high = min(low, float(made.errors.min())), max(high, float(made.errors.max()))
    sound = low >= 0.1 and high <= 1000.0
    return Reading(outcome=f"{low:.3g} to {high:.4g}", float32="ok", is_refuted=not sound)


def _corners() -> Reading:
    """Patches at every edge, wrapped and not: within the image, the last rows and columns reached."""
    rows, columns = uniform_corners((_HEIGHT, _WIDTH), (2, 8), 20_000, _generator())
    r, c = patch_pixels(rows, columns, (2, 8), (_HEIGHT, _WIDTH))
    reached = int(r.max()) == _HEIGHT - 1 and int(c.max()) == _WIDTH - 1 and int(c.min()) == 0
    far = torch.tensor([10**6]), torch.tensor([_WIDTH - 1])
    wr, wc = patch_pixels(*far, (2, 8), (_HEIGHT, _WIDTH), wrap=True)
    wrapped = wc[0, 0].tolist() == [_WIDTH - 1, *range(7)] and int(wr.max()) == _HEIGHT - 1
    return Reading(
        outcome=f"edges reached {reached}, wrapped {wrapped}", is_refuted=not (reached and wrapped)
    )


def _none_drawable() -> Reading:
    blind = torch.zeros(4, 4, dtype=torch.bool)
    return refused(ShapeError, lambda: uniform_pixels((4, 4), 3, _generator(), blind))


_FIRST_PIXEL = (torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=torch.int64))
_DRAW = "sampling.error_map.ErrorMap.sample_pixels"
CASES = (
    Case(_DRAW, "one-hot weights, 500 draws of one cell", _one_hot),
    Case(_DRAW, "weights 1 and 1000: shares of 4,000 draws", lambda: _shares(1000.0)),
    Case(_DRAW, "equal weights", lambda: _shares(1.0)),
    Case(_DRAW, "weights 1e-30 and 1e30", _tiny_and_huge),
    Case("sampling.error_map.ErrorMap.update", "errors 0 to 3e38 and all equal", _update),
    Case("sampling.patches.patch_pixels", "corners at and beyond every edge", _corners),
    Case(_DRAW, "all-zero weights (outside)", _all_zero),
    Case(_DRAW, "an infinite weight (outside)", lambda: _broken(math.inf)),
    Case(_DRAW, "a NaN weight (outside)", lambda: _broken(math.nan)),
    Case(
        "sampling.error_map.ErrorMap.update", "a NaN error (outside)",
        lambda: refused(DivergedError, lambda: _map().update(0, *_FIRST_PIXEL, torch.tensor([math.nan]))),
    ),
    Case("sampling.pixels.uniform_pixels", "no drawable pixel (outside)", _none_drawable),
)  # fmt: skip
