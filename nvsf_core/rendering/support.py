"""Support: what recorded data know about a rendered return or pixel."""

from enum import IntEnum


class Support(IntEnum):
    """How well recorded data support a rendered return or pixel; ordered, stored as uint8."""

    GUESSED = 0
    """No observation: no sensor of this kind recorded the place that is shown. So are a LiDAR's returns from
    surfaces that only images show: their ranges are those of depths from images."""
    EXTRAPOLATED = 1
    """The place was recorded, but from elsewhere: along directions or from distances unlike this ray's."""
    SEEN = 2
    """The place was recorded by rays of about the same place and direction."""

    @property
    def region(self) -> str:
        """Name of the part of a scan or an image that has this support, as in the column `region`."""
        return f"support_{self.name.lower()}"


SUPPORTED = "supported"
"""Region of all that is seen or extrapolated."""
