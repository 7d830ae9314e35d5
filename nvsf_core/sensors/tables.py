"""Rotating LiDARs as tables of lasers: elevation, lever arms, encoder phase, biases.

The model of a return of laser l at range r (metres), after the one ALICE-LRI estimates (arXiv 2510.20708):
    elevation = elevation_l + vertical_offset_l / r
    azimuth   = theta + horizontal_offset_l / (r cos elevation_l)
with theta = (column + phase_l) 2 pi / lattice_steps the encoder's angle. All lasers fire together:
(column + firing_shift_l) mod lattice_steps is one firing column, common to all of them.
Lasers are ordered from the top.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from nvsf_core.errors import DataError


@dataclass(frozen=True, slots=True, eq=False)
class LaserTable:
    """One rotating LiDAR: L lasers, ordered from the top."""

    name: str
    """Name by which catalogues ask for it."""
    elevation_rad: np.ndarray
    """(L,) float64, elevation of each laser's recorded points at infinite range."""
    vertical_offset_m: np.ndarray
    """(L,) float64, lever arm across the ray, upwards."""
    horizontal_offset_m: np.ndarray
    """(L,) float64, lever arm across the ray, to the left (towards growing azimuth)."""
    phase_steps: np.ndarray
    """(L,) float64, angle of a laser against the encoder's lattice, in its steps."""
    firing_shift_steps: np.ndarray
    """(L,) int64, added to a laser's encoder column to give the firing column common to all lasers."""
    lattice_steps: int
    """Encoder steps per rotation."""
    firings_per_turn: int
    """Usual number of firings per sweep."""
    max_range_m: float
    """Beyond this the sensor records nothing."""
    elevation_correction_rad: float
    """Recorded rays are turned up by this angle on the way into the world; the files lack it."""
    range_bias_m: np.ndarray
    """(L,) float64, by how much a laser measures too long; learned from a drive, else 0."""
    intensity_gain: np.ndarray
    """(L,) float64, factor by which a laser sees brighter than the others; learned from a drive, else 1."""
    rate_hz: float | None = None
    """Rotations a second; None = as the drive's own sensor rotates: makers let the user choose 5 to 20."""
    divergence_mrad: float = 0.0
    """Full angle of a beam, the wider of its two; 0 = not known."""

    @property
    def laser_count(self) -> int:
        """Number of lasers L."""
        return len(self.elevation_rad)

    @property
    def step_rad(self) -> float:
        """Angle of one encoder step."""
        return 2.0 * np.pi / self.lattice_steps


_HDL_64E_ELEVATION_DEG = (
    1.9364, 1.5737, 1.3045, 0.8713, 0.5785, 0.1804, -0.089, -0.4521, -0.8034, -1.2015,
    -1.4941, -1.8335, -2.2078, -2.5469, -2.8741, -3.2361, -3.5396, -3.9361, -4.2158, -4.5884,
    -4.9141, -5.2511, -5.6109, -5.9587, -6.3292, -6.6761, -6.9994, -7.2877, -7.6792, -8.0584,
    -8.3109, -8.7118, -9.0261, -9.5736, -10.0626, -10.4709, -10.9571, -11.5991, -12.1152, -12.5623,
    -13.0412, -13.485, -14.0485, -14.5982, -15.1889, -15.6569, -16.1768, -16.5542, -17.187, -17.7306,
    -18.3236, -18.7973, -19.3205, -19.7366, -20.2228, -20.7879, -21.3184, -21.9357, -22.4378, -22.8568,
    -23.3226, -23.9713, -24.5069, -24.9995,
)  # fmt: skip
_HDL_64E_VERTICAL_OFFSET_M = (
    0.2091, 0.2086, 0.2083, 0.2078, 0.2074, 0.2069, 0.2065, 0.2061, 0.2057, 0.2051,
    0.2048, 0.2044, 0.2039, 0.2035, 0.203, 0.2026, 0.2022, 0.2017, 0.2014, 0.2009,
    0.2005, 0.2, 0.1996, 0.1992, 0.1987, 0.1982, 0.1978, 0.1975, 0.197, 0.1965,
    0.1962, 0.1956, 0.1243, 0.1237, 0.1231, 0.1227, 0.1221, 0.1214, 0.1208, 0.1203,
    0.1198, 0.1193, 0.1186, 0.118, 0.1173, 0.1168, 0.1162, 0.1157, 0.115, 0.1143,
    0.1136, 0.113, 0.1124, 0.1119, 0.1113, 0.1106, 0.1099, 0.1092, 0.1085, 0.108,
    0.1074, 0.1066, 0.1059, 0.1052,
)  # fmt: skip
_HDL_64E_PHASE_STEPS = (
    -0.404, 0.307, 0.28, 0.478, 0.129, 0.107, -0.122, -0.133, -0.078, -0.138,
    -0.118, -0.087, 0.122, -0.454, 0.396, -0.499, 0.395, -0.495, 0.33, 0.28,
    0.026, -0.027, 0.391, 0.48, 0.151, 0.044, 0.061, -0.367, 0.006, 0.076,
    -0.472, 0.405, -0.179, -0.143, -0.346, 0.361, 0.422, 0.341, 0.485, -0.224,
    0.175, 0.093, 0.246, -0.434, 0.2, 0.256, -0.208, -0.341, 0.315, -0.498,
    0.229, -0.448, -0.207, 0.171, 0.118, 0.187, -0.254, 0.335, 0.388, 0.08,
    0.391, -0.367, -0.229, -0.351,
)  # fmt: skip
_HDL_64E_FIRING_SHIFT_STEPS = (
    -29, -3, 19, 44, -68, -43, -20, 5, 27, 52, -76, -51, -29, -4, 19, 43,
    -67, -43, -20, 5, 27, 52, -76, -51, -29, -4, 20, 43, -68, -43, -21, 5,
    -37, -1, 35, 73, -97, -61, -24, 13, 49, 87, -112, -75, -38, 0, 36, 74,
    -100, -62, -25, 13, 50, 89, -115, -77, -40, 0, 38, 76, -103, -64, -26, 13,
)  # fmt: skip
# HDL-32E User's Manual (63-9113), firing order and vertical angles: thirds of 4 degrees from 10.67 to -30.67.
_HDL_32E_DEG = np.round(np.arange(8, -24, -1) * (4.0 / 3.0), 2)
# VLS-128 User Manual; the same angles stand in Velodyne's drivers, channel by channel.
_VLS_128_DEG = np.array([
    15.0, 11.75, 9.7, 8.43, 7.58, 6.98, 6.48, 6.08, 5.73, 5.43, 5.18, 4.98, 4.83, 4.72, 4.61, 4.5, 4.39,
    4.28, 4.17, 4.06, 3.95, 3.84, 3.73, 3.62, 3.51, 3.4, 3.29, 3.18, 3.07, 2.96, 2.85, 2.74, 2.63, 2.52,
    2.41, 2.3, 2.19, 2.08, 1.97, 1.86, 1.75, 1.64, 1.53, 1.42, 1.31, 1.2, 1.09, 0.98, 0.87, 0.76, 0.65,
    0.54, 0.43, 0.32, 0.21, 0.1, -0.01, -0.12, -0.23, -0.34, -0.45, -0.56, -0.67, -0.78, -0.89, -1.0, -1.11,
    -1.22, -1.33, -1.44, -1.55, -1.66, -1.77, -1.88, -1.99, -2.1, -2.21, -2.32, -2.43, -2.54, -2.65, -2.76,
    -2.87, -2.98, -3.09, -3.2, -3.31, -3.42, -3.53, -3.64, -3.75, -3.86, -3.97, -4.08, -4.19, -4.3, -4.41,
    -4.52, -4.63, -4.74, -4.85, -4.96, -5.07, -5.18, -5.29, -5.4, -5.51, -5.62, -5.73, -5.84, -5.95, -6.06,
    -6.17, -6.28, -6.39, -6.5, -6.65, -6.85, -7.15, -7.65, -8.352, -9.244, -10.346, -11.742, -13.565,
    -16.042, -19.582, -25.0,
])  # fmt: skip
# Hesai's general ROS driver (HesaiLidar_General_ROS), Pandar64.
_PANDAR_64_DEG = np.array([
    14.882, 11.032, 8.059, 5.057, 3.04, 2.028, 1.86, 1.688, 1.522, 1.351, 1.184, 1.013, 0.846, 0.675, 0.508,
    0.337, 0.169, 0.0, -0.169, -0.337, -0.508, -0.675, -0.845, -1.013, -1.184, -1.351, -1.522, -1.688, -1.86,
    -2.028, -2.198, -2.365, -2.536, -2.7, -2.873, -3.04, -3.21, -3.375, -3.548, -3.712, -3.884, -4.05, -4.221,
    -4.385, -4.558, -4.72, -4.892, -5.057, -5.229, -5.391, -5.565, -5.726, -5.898, -6.061, -7.063, -8.059,
    -9.06, -9.885, -11.032, -12.006, -12.974, -13.93, -18.889, -24.897,
])  # fmt: skip
# The manual lists them from -15 to 15 degrees, 11.2 to -11.2 mm; ours run from the top.
_VLP_16_VERTICAL_OFFSET_MM = (
    -11.2, -9.7, -8.1, -6.6, -5.1, -3.7, -2.2, -0.7, 0.7, 2.2, 3.7, 5.1, 6.6, 8.1, 9.7, 11.2,
)  # fmt: skip


def _frozen(values: object, dtype: type = np.float64) -> np.ndarray:
    array: np.ndarray = np.array(values, dtype)
    array.flags.writeable = False
    return array


HDL_64E = LaserTable(
    name="HDL-64E",
    elevation_rad=_frozen(np.deg2rad(_HDL_64E_ELEVATION_DEG)),
    vertical_offset_m=_frozen(_HDL_64E_VERTICAL_OFFSET_M),
    horizontal_offset_m=_frozen([-0.026, 0.026] * 32),
    phase_steps=_frozen(_HDL_64E_PHASE_STEPS),
    firing_shift_steps=_frozen(_HDL_64E_FIRING_SHIFT_STEPS, np.int64),
    lattice_steps=4000,
    firings_per_turn=2172,
    max_range_m=120.0,
    elevation_correction_rad=float(np.deg2rad(0.205)),
    range_bias_m=_frozen(np.zeros(64)),
    intensity_gain=_frozen(np.ones(64)),
    divergence_mrad=2.0,
)
"""Velodyne HDL-64E of KITTI and KITTI-360, measured on their raw scans (0.01 deg, 1 mm)."""


# Wide: each is a fact of a sensor's data sheet.
def even_table(
    name: str,
    elevation_deg: np.ndarray,
    *,
    firings: int,
    max_range_m: float,
    rate_hz: float | None = None,
    divergence_mrad: float = 0.0,
    vertical_offset_m: np.ndarray | None = None,
    horizontal_offset_m: np.ndarray | None = None,
) -> LaserTable:
    """A sensor all of whose lasers look the same way when they fire, as a data sheet describes it.

    Args:
        name: Its name.
        elevation_deg: (L,) from the top.
        firings: Firings of a rotation, evenly spaced.
        max_range_m: Beyond this it records nothing.
        rate_hz: Rotations a second; None = those of the drive's sensor.
        divergence_mrad: Full angle of a beam; 0 = not known.
        vertical_offset_m: (L,) lever arms upwards; None = 0.
        horizontal_offset_m: (L,) lever arms to the left; None = 0.
    """
    lasers = len(elevation_deg)
    none: np.ndarray = np.zeros(lasers)
    return LaserTable(
        name=name,
        elevation_rad=_frozen(np.deg2rad(elevation_deg)),
        vertical_offset_m=_frozen(none if vertical_offset_m is None else vertical_offset_m),
        horizontal_offset_m=_frozen(none if horizontal_offset_m is None else horizontal_offset_m),
        phase_steps=_frozen(none),
        firing_shift_steps=_frozen(none, np.int64),
        lattice_steps=firings,
        firings_per_turn=firings,
        max_range_m=max_range_m,
        elevation_correction_rad=0.0,
        range_bias_m=_frozen(none),
        intensity_gain=_frozen(np.ones(lasers)),
        rate_hz=rate_hz,
        divergence_mrad=divergence_mrad,
    )


VLP_16 = even_table(
    "VLP-16", np.arange(15.0, -16.0, -2.0), firings=1808, max_range_m=100.0, divergence_mrad=3.0,
    vertical_offset_m=np.array(_VLP_16_VERTICAL_OFFSET_MM) * 1e-3,
)  # fmt: skip
"""Velodyne VLP-16 at 600 rotations per minute, nominal: 2 degrees apart, 55.296 us per firing, beams of 3.0 x
1.5 mrad (User Manual 63-9243)."""

OS1_128 = even_table(
    "OS1-128", np.linspace(22.5, -22.5, 128), firings=1024, max_range_m=120.0, divergence_mrad=3.14
)
"""Ouster OS1-128 at 1024 columns, nominal: 45 degrees evenly divided (the data sheet gives the range only,
each unit has its own beam angles), one origin, no column stagger, beams of 0.18 degrees."""

OS1_64 = even_table(
    "OS1-64", np.linspace(16.6, -16.6, 64), firings=1024, max_range_m=120.0, divergence_mrad=2.27
)
"""Ouster OS1-64 at 1024 columns, nominal: 33.2 degrees evenly divided (likewise), beams of 0.13 degrees (OS1
data sheet)."""

HDL_32E = even_table("HDL-32E", _HDL_32E_DEG, firings=2170, max_range_m=100.0)
"""Velodyne HDL-32E at 600 rotations per minute: 46.08 us per firing (User's Manual); lever arms and beam
widths are not published there."""

VLS_128 = even_table("VLS-128", _VLS_128_DEG, firings=1876, max_range_m=245.0, divergence_mrad=3.0)
"""Velodyne VLS-128 at 600 rotations per minute: 53.3 us per firing, beams of 3.0 x 1.5 mrad (User Manual).
Its lasers look up to 6 degrees aside of each other, which is left out: all look the same way."""

PANDAR_64 = even_table("Pandar64", _PANDAR_64_DEG, firings=1800, max_range_m=200.0)
"""Hesai Pandar64 at 600 rotations per minute, 0.2 degrees. Its lasers look up to 5.2 degrees aside of each
other, which is left out; beam widths are not known here."""

SENSOR_TABLES = {
    table.name: table for table in (HDL_64E, HDL_32E, VLP_16, VLS_128, OS1_64, OS1_128, PANDAR_64)
}


def sensor_table(name: str) -> LaserTable:
    """The table of a sensor, by its name.

    Raises:
        DataError: No such sensor is known.
    """
    if name not in SENSOR_TABLES:
        known = ", ".join(sorted(SENSOR_TABLES))
        raise DataError(f"expected a sensor among {known}, found {name!r}; correct the catalogue")
    return SENSOR_TABLES[name]


ATTRIBUTE = "sensor_table"
"""Attribute of `returns.zarr` with the values of a table that is not known by its name."""
_WHOLE = ("firing_shift_steps",)


def table_facts(table: LaserTable) -> dict[str, Any]:
    """A table's values as JSON holds them."""
    values = {one.name: getattr(table, one.name) for one in fields(table)}
    return {name: one.tolist() if isinstance(one, np.ndarray) else one for name, one in values.items()}


def recorded_table(attrs: Mapping[str, Any]) -> LaserTable:
    """The table of the recording sensor, from the attributes of `returns.zarr`.

    A known sensor is stored by its name, one that was found from the scans with all its values.

    Raises:
        DataError: It is no known sensor, and its values are not stored.
    """
    stored = attrs.get(ATTRIBUTE)
    if stored is None or attrs["sensor"] in SENSOR_TABLES:
        return sensor_table(attrs["sensor"])
    values: dict[str, Any] = {
        name: np.array(one, np.int64 if name in _WHOLE else np.float64) if isinstance(one, list) else one
        for name, one in stored.items()
    }
    return LaserTable(**values)
