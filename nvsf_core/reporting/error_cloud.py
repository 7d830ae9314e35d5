"""The paper's error cloud: a recorded scan seen from above, coloured by range error."""

import numpy as np

from nvsf_core.reporting.html import image
from nvsf_core.reporting.previews import palette_png, top_view_levels

ERROR_CLOUD_NAME = "error_cloud.png"
"""File of the picture beside a field's metrics."""
WRONG_M = 1.0
"""A range error above it is red."""
WRONG_COLOUR = (255, 45, 45)

_GREYS = 64
_RED = _GREYS + 1
_DARKEST, _LIGHTEST = 120.0, 225.0


def error_cloud_png(
    points_m: np.ndarray, range_error_m: np.ndarray, extent_m: float = 40.0, pixels: int = 640
) -> bytes:
    """PNG of recorded returns seen from above, forward up: red above 1 m of range error, else grey.

    The greys run from dark (no error) to light (1 m). A cell shows the worst of its returns.

    Args:
        points_m: (N, 3) recorded returns in the sensor's frame, metres.
        range_error_m: (N,) absolute error along each return's own ray, metres; infinite = no return was
            rendered, which is red.
        extent_m: From the sensor to the picture's border, metres.
        pixels: Side of the square picture.
    """
    # A NaN is red too.
    wrong = ~(range_error_m <= WRONG_M)
    share = np.where(wrong, 0.0, range_error_m / WRONG_M)
    level = np.where(wrong, _RED, 1 + np.rint(share * (_GREYS - 1)).astype(np.int64))
    palette = np.zeros((256, 3), np.uint8)
    palette[1:_RED] = np.rint(np.linspace(_DARKEST, _LIGHTEST, _GREYS))[:, None]
    palette[_RED] = WRONG_COLOUR
    return palette_png(top_view_levels(points_m, level, extent_m, pixels), palette)


def error_cloud_figure(png: bytes | None) -> str:
    """HTML of the picture of `error_cloud_png` with its legend; empty for None."""
    if png is None:
        return ""
    return (
        f"<figure>{image(png, 'range errors from above')}<figcaption>Recorded returns of a held-out frame"
        " from above, 80 m by 80 m, driving direction up: red where the model’s range along the return’s own"
        " ray is more than 1 m wrong, else grey, the lighter the worse.</figcaption></figure>"
    )
