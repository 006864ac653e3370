"""The Velodyne VLP-16 (Puck): 16 lasers, two firings a block.

Source: VLP-16 user's manual 63-9243 Rev. D: elevations and vertical corrections (table 9-1), timing (section 9.3.2 and figure 9-3), packet
(section 9.3). The sensor frame is that of the HDL-32E: x right (the cable's side is behind), y forward at azimuth 0, z up; azimuth grows
clockwise seen from above. A block states the azimuth of its first firing; that of the second, and of each laser, is interpolated.
"""

from typing import Final

import numpy as np

from groundproc.sensors.firings import RETURNS, Firing
from groundproc.sensors.shots import LaserTable
from groundproc.sensors.velodyne import Velodyne

PRODUCT_ID: Final = 0x22
PROTOTYPE_ID: Final = 0x21
"""A prototype states the HDL-32E's product [measured]."""
LASERS: Final = 16
LASER_NS: Final = 2_304
"""From one laser to the next [ns]."""
FIRING_NS: Final = 55_296
"""From one firing of all 16 lasers to the next [ns]: 24 cycles, of which 16 fire."""
FIRINGS: Final = 2
"""In a block."""

ELEVATION_DEG: Final = (-15.0, 1.0, -13.0, 3.0, -11.0, 5.0, -9.0, 7.0, -7.0, 9.0, -5.0, 11.0, -3.0, 13.0, -1.0, 15.0)
"""In firing order."""
HEIGHT_MM: Final = (11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2)
"""Vertical correction: where each beam crosses the spin axis, over the sensor's origin."""

_RETURN: Final = np.arange(RETURNS)

LIDAR: Final = Velodyne(
    name="VLP-16",
    product=PRODUCT_ID,
    lasers=LaserTable.of_elevations(ELEVATION_DEG, np.array(HEIGHT_MM) * 1e-3),
    firing=Firing(
        block_ns=FIRINGS * FIRING_NS,
        offset_ns=_RETURN // LASERS * FIRING_NS + _RETURN % LASERS * LASER_NS,
        laser=(_RETURN % LASERS).astype(np.uint8),
    ),
    firing_ns=FIRING_NS,
    laser_ns=LASER_NS,
    lent_products=(PROTOTYPE_ID,),
)
