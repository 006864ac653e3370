"""The Velodyne HDL-32E: 32 lasers, one firing a block. Its table of facts is `flightlog.hdl32e`, which recorder and simulator share."""

from typing import Final

import numpy as np

from flightlog.hdl32e import ELEVATION_DEG, FIRING_NS, LASER_NS, LASERS, PRODUCT_ID
from groundproc.sensors.firings import Firing
from groundproc.sensors.shots import LaserTable
from groundproc.sensors.velodyne import Velodyne

_NUMBER: Final = np.arange(LASERS)

LIDAR: Final = Velodyne(
    name="HDL-32E",
    product=PRODUCT_ID,
    lasers=LaserTable.of_elevations(ELEVATION_DEG),
    firing=Firing(FIRING_NS, _NUMBER * LASER_NS, _NUMBER.astype(np.uint8)),
    firing_ns=FIRING_NS,
    laser_ns=LASER_NS,
    blank=True,
)
