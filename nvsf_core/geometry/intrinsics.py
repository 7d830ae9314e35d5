"""Which numbers can be a camera's: focal lengths, optical axis and image size that somebody could build."""

import math

__all__ = ["FOCAL_WIDTHS", "MOST_PIXELS", "MOST_SIDE_PX", "intrinsics_fault"]

FOCAL_WIDTHS = (0.05, 50.0)
"""Focal length over image width: from beyond any fisheye (0.05) to a telescope (50)."""
MOST_SIDE_PX = 16_384
"""Longest side of an image."""
MOST_PIXELS = 64_000_000
"""Largest image: eight times what cars have, and what a drive's images must fit into memory with."""
_MOST_ASPECT = 4.0
"""Of one focal length over the other: cameras have square pixels, some films twice as wide as high."""
_AXIS_SIDES = 1.0
"""How many sides the optical axis may lie outside of the image."""


def intrinsics_fault(
    focal_px: tuple[float, float], axis_px: tuple[float, float], size_px: tuple[float, float]
) -> str | None:
    """What is unphysical about a camera; None where nothing is.

    A focal length of 1e-300 is positive and finite, and its rays are not: coordinates overflow far away
    from here, where nobody can tell why.

    Args:
        focal_px: Horizontal and vertical focal length (or scale, of a fisheye), pixels.
        axis_px: Column and row of the optical axis, pixels.
        size_px: Width and height of the image, pixels.
    """
    if not all(map(math.isfinite, (*focal_px, *axis_px, *size_px))):
        return f"expected finite intrinsics, found focal {focal_px}, axis {axis_px}, size {size_px}"
    width, height = size_px
    whole = width == int(width) and height == int(height)
    if not whole or not 1 <= min(size_px) <= max(size_px) <= MOST_SIDE_PX or width * height > MOST_PIXELS:
        return (
            f"expected whole image sides from 1 to {MOST_SIDE_PX} pixels, at most {MOST_PIXELS:,} pixels "
            f"in all, found {width:g} x {height:g}"
        )
    least, most = (share * width for share in FOCAL_WIDTHS)
    if not all(least <= focal <= most for focal in focal_px):
        return (
            f"expected focal lengths of {FOCAL_WIDTHS[0]:g} to {FOCAL_WIDTHS[1]:g} image widths "
            f"({least:g} to {most:g} pixels), found {focal_px[0]:g} and {focal_px[1]:g}"
        )
    if max(focal_px) > _MOST_ASPECT * min(focal_px):
        return (
            f"expected pixels that are nearly square, found focal lengths {focal_px[0]:g} and {focal_px[1]:g}"
        )
    for place, side, word in zip(axis_px, size_px, ("column", "row"), strict=True):
        if not -_AXIS_SIDES * side <= place <= (1.0 + _AXIS_SIDES) * side:
            return (
                f"expected the optical axis near the image, found its {word} at {place:g} of {side:g} pixels"
            )
    return None
