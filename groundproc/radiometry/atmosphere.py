"""How much light the air lets through."""

from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import UsageError

Array = npt.NDArray[np.float64]

_KOSCHMIEDER: Final = 3.91
"""Extinction times visibility, by which contrast falls to 2 %."""
_REFERENCE_NM: Final = 550.0
LEAST_KM: Final = 0.5
"""In fog the law does not hold (Pierce 2001)."""


def extinction_per_m(visibility_km: float, wavelength_nm: float) -> float:
    """Extinction of air [1/m] by Kruse's law.

    Parameters
    ----------
    visibility_km : float
    wavelength_nm : float

    Raises
    ------
    UsageError
        The visibility is that of fog, or the wavelength none of a lidar.

    Source: Kruse, McGlauchlin and McQuistan, "Elements of Infrared Technology" (1962).
    """
    if not visibility_km >= LEAST_KM:
        raise UsageError(f"visibility {visibility_km:g} km: expected {LEAST_KM:g} km or more; fog follows no such law")
    if not 300.0 <= wavelength_nm <= 2500.0:
        raise UsageError(f"wavelength {wavelength_nm:g} nm: expected 300 to 2500 nm, such as 905")
    far = 1.6 if visibility_km > 50.0 else 1.3
    q = 0.585 * visibility_km ** (1.0 / 3.0) if visibility_km < 6.0 else far
    return float(_KOSCHMIEDER / visibility_km * (wavelength_nm / _REFERENCE_NM) ** -q / 1e3)


def transmission(range_m: Array, visibility_km: float | None, wavelength_nm: float) -> Array:
    """Share of the light that comes through on both ways, shape (n,); 1 where no visibility is known."""
    if visibility_km is None:
        return np.ones(len(range_m))
    return np.asarray(np.exp(-2.0 * extinction_per_m(visibility_km, wavelength_nm) * range_m))
