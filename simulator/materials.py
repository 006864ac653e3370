"""What surfaces are made of: reflectance at 905 nm and how it falls off with the angle of incidence.

Reflectances are from FOI-R--4045--SE (2014), appendix B, middle of the range given. The returned strength is taken as
reflectance * cos(incidence) ** falloff: 1 for a Lambertian surface; rough ones keep their brightness (the same source sees asphalt
at 80 deg beyond 30 m and grass there with an intensity of 34, which gives 0.06 and 0.4).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class Material:
    """Reflectance at normal incidence (above 1: retro-reflecting), exponent of the falloff, share of light let through."""

    name: str
    reflectance: float
    falloff: float = 1.0
    transmission: float = 0.0


TABLE: Final = (
    Material("grass", 0.70, 0.4),
    Material("soil", 0.35, 0.4),
    Material("asphalt", 0.10, 0.06),
    Material("concrete", 0.30, 0.6),
    Material("brick", 0.50, 0.8),
    Material("plaster", 0.65),
    Material("wood", 0.85, 0.9),
    Material("leaf", 0.52, 0.5),
    Material("bark", 0.65, 0.7),
    Material("metal", 0.30, 1.5),
    Material("car_paint", 0.40, 1.2),
    Material("roof_tile", 0.40, 0.7),
    Material("wire", 0.30, 0.5),
    Material("glass", 0.06, 2.0, 0.86),
    Material("panel_4.6", 0.046),
    Material("panel_30.3", 0.303),
    Material("panel_81.3", 0.813),
    Material("retro", 60.0, 0.5),
    Material("cloth", 0.45),
    # a mirror made rough by small waves: bright within some 10 deg of the vertical, black beyond; not of the source
    Material("water", 0.3, 40.0),
    Material("crop", 0.60, 0.4),
)
INDEX: Final = {material.name: i for i, material in enumerate(TABLE)}

REFLECTANCE: Final[npt.NDArray[np.float64]] = np.array([material.reflectance for material in TABLE])
FALLOFF: Final[npt.NDArray[np.float64]] = np.array([material.falloff for material in TABLE])
TRANSMISSION: Final[npt.NDArray[np.float64]] = np.array([material.transmission for material in TABLE])
