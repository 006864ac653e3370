"""Numbers of ASPRS classes that the programs give or look at (LAS 1.4 R15, table 17)."""

from typing import Final

UNCLASSIFIED: Final = 1
GROUND: Final = 2
LOW_NOISE: Final = 7
HIGH_NOISE: Final = 18
MOVING: Final = 64
"""What moves, people and cars: of the range that LAS leaves to the user."""
NO_SURFACE: Final = (LOW_NOISE, HIGH_NOISE, MOVING)
"""What belongs to no surface that stands: left out of heights, rasters, volumes and comparisons unless they are asked for."""
