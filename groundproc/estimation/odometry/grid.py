"""The grid that motion is kept on, and slices of it."""

from typing import Final

STEP_NS: Final = 5_000_000
"""Step of the grid that motion is kept on."""
STEPS: Final = 20
"""Grid steps of a slice."""
SLICE_NS: Final = STEP_NS * STEPS
