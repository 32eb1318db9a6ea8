"""Firing patterns of real LiDARs by the names of their models.

HDL-64E: two blocks of 32 lasers, 1/3 and 1/2 deg apart, as its user's manual states them.
VLP-32C: the table of elevations in its user's manual (63-9325). Pandar64: the spacings in its data
sheet: 1/6 deg from +2 to -6 deg, 1 deg to -14, then wider. OS1-128: 45 deg in equal steps, as its
data sheet states. Elevations differ by some hundredths of a degree from device to device.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_HDL_64E = (*(2 - n / 3 for n in range(32)), *(-8.83 - n / 2 for n in range(32)))
_VLP_32C = (
    *(15.0, 10.333, 7.0, 4.667, 3.333, 2.333),
    *(5 / 3 - n / 3 for n in range(18)),  # to -4 deg
    *(-4.667, -5.333, -6.148, -7.254, -8.843, -11.31, -15.639, -25.0),
)
_PANDAR64 = (
    *(15.0, 11.0, 8.0, 5.0, 3.0),
    *(2 - n / 6 for n in range(49)),  # to -6 deg
    *(-7.0 - n for n in range(8)),
    *(-19.0, -25.0),
)


@dataclass(frozen=True, slots=True)
class SensorModel:
    """A LiDAR at 10 Hz: elevations of its rings from top to bottom, deg; columns; range, m."""

    elevations_deg: tuple[float, ...]
    columns: int
    range_m: float


SENSOR_MODELS = {
    "hdl-64e": SensorModel(_HDL_64E, 1800, 120.0),
    "vlp-32c": SensorModel(_VLP_32C, 1800, 200.0),
    "pandar64": SensorModel(_PANDAR64, 1800, 200.0),
    "os1-128": SensorModel(tuple(np.linspace(22.5, -22.5, 128).tolist()), 1024, 120.0),
}
