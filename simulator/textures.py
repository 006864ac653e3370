"""What surfaces look like: albedo in the bands of cameras and temperature, by material and place.

Albedos and temperatures are those of textbooks, rounded; on each lies a pattern of lumps from centimetres to metres (value noise in space,
hashed by material), which gives pictures something to match, and on plants a slower one from dry to vigorous.
"""

from dataclasses import dataclass
from typing import Final

import numba as nb
import numpy as np
import numpy.typing as npt

from simulator.materials import INDEX, TABLE

Array = npt.NDArray[np.float64]

BANDS: Final = ("red", "green", "blue", "nir", "red_edge", "temperature")
TEMPERATURE: Final = BANDS.index("temperature")
_WAVES_M: Final = 0.05 * 2.0 ** np.arange(9)
_GROWTH: Final = 0.08
"""The pattern's amplitude grows with its wavelength to this power."""
_VIGOUR_M: Final = 5.0


@dataclass(frozen=True, slots=True)
class Look:
    """A material as cameras see it.

    Attributes
    ----------
    albedo : tuple of float
        Red, green, blue, near infrared, red edge.
    celsius : float
    contrast : float
        Of the pattern, relative.
    dry : tuple of float, optional
        The other end of a plant's vigour.
    """

    albedo: tuple[float, float, float, float, float]
    celsius: float
    contrast: float = 0.5
    dry: tuple[float, float, float, float, float] | None = None


def _grey(value: float, celsius: float) -> Look:
    return Look((value,) * 5, celsius, 0.0)


LOOKS: Final = {
    "grass": Look((0.07, 0.12, 0.05, 0.48, 0.28), 22.0, 0.6, (0.24, 0.22, 0.13, 0.36, 0.30)),
    "soil": Look((0.22, 0.17, 0.12, 0.30, 0.26), 28.0),
    "asphalt": Look((0.11, 0.11, 0.11, 0.13, 0.12), 35.0, 0.5),
    "concrete": Look((0.36, 0.35, 0.32, 0.38, 0.37), 30.0, 0.35),
    "brick": Look((0.36, 0.20, 0.14, 0.42, 0.39), 27.0),
    "plaster": Look((0.58, 0.55, 0.48, 0.60, 0.59), 25.0, 0.3),
    "wood": Look((0.34, 0.26, 0.18, 0.48, 0.40), 26.0),
    "leaf": Look((0.05, 0.10, 0.04, 0.50, 0.28), 20.0, 0.7, (0.16, 0.18, 0.07, 0.40, 0.29)),
    "bark": Look((0.18, 0.14, 0.10, 0.34, 0.26), 21.0),
    "metal": Look((0.42, 0.43, 0.45, 0.40, 0.41), 32.0, 0.2),
    "car_paint": Look((0.40, 0.12, 0.12, 0.45, 0.43), 34.0, 0.15),
    "roof_tile": Look((0.34, 0.17, 0.12, 0.38, 0.36), 36.0, 0.6),
    "wire": Look((0.12, 0.12, 0.12, 0.15, 0.13), 24.0, 0.1),
    "glass": Look((0.06, 0.08, 0.09, 0.06, 0.06), 20.0, 0.1),
    "panel_4.6": _grey(0.046, 15.0),
    "panel_30.3": _grey(0.303, 25.0),
    "panel_81.3": _grey(0.813, 40.0),
    "retro": _grey(0.7, 24.0),
    "cloth": Look((0.30, 0.28, 0.36, 0.50, 0.45), 30.0),
    "water": Look((0.03, 0.05, 0.06, 0.01, 0.02), 16.0, 0.3),
    "crop": Look((0.05, 0.11, 0.04, 0.52, 0.30), 21.0, 0.6, (0.20, 0.20, 0.10, 0.38, 0.30)),
}  # fmt: skip
SKY: Final = np.array([0.35, 0.50, 0.75, 0.20, 0.25, -30.0])
PLANTS: Final = ("grass", "leaf", "crop")


def _table() -> Array:
    """For each material its bands vigorous, its bands dry, and its contrast, shape (materials, 2 bands + 1)."""
    rows = []
    for material in TABLE:
        look = LOOKS[material.name]
        both = [(*values, look.celsius) for values in (look.albedo, look.dry or look.albedo)]
        rows.append([*both[0], *both[1], look.contrast])
    return np.array(rows)


TABLE_OF_LOOKS: Final = _table()
_SUN: Final = np.array([0.40, -0.35, 0.85]) / np.linalg.norm([0.40, -0.35, 0.85])
_AMBIENT: Final = 0.3


@nb.njit(cache=True, nogil=True, inline="always")
def _hashed(x: int, y: int, z: int, salt: int) -> float:
    """A number from -1 to 1 that looks random, of four whole ones."""
    # whole numbers of 64 bit wrap round; their upper half is mixed best (splitmix64)
    h = np.uint64((x * 73856093) ^ (y * 19349663) ^ (z * 83492791) ^ (salt * 6_700_417)) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return float(h >> np.uint64(32)) * (2.0 / 4294967295.0) - 1.0


@nb.njit(cache=True, nogil=True)
def _lumps(x: float, y: float, z: float, salt: int) -> float:
    """Value noise of wavelength one: hashed corners of a cube, blended smoothly."""
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    u, v, w = x - i, y - j, z - k
    u, v, w = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v), w * w * (3.0 - 2.0 * w)
    total = 0.0
    for a in range(2):
        share_a = u if a else 1.0 - u
        for b in range(2):
            share_b = share_a * (v if b else 1.0 - v)
            for c in range(2):
                total += share_b * (w if c else 1.0 - w) * _hashed(i + a, j + b, k + c, salt)
    return total


@nb.njit(cache=True, nogil=True)
def _pattern(x: float, y: float, z: float, salt: int, blur_m: float) -> float:
    """The sum of lumps of all sizes that are not lost in a pixel so wide; about 0.4 rms."""
    total, norm = 0.0, 0.0
    for n in range(len(_WAVES_M)):
        wave = _WAVES_M[n]
        strength = wave**_GROWTH
        norm += strength * strength
        share = min(max((wave / max(blur_m, 1e-6) - 1.5) / 1.5, 0.0), 1.0)
        if share > 0.0:
            total += share * strength * _lumps(x / wave, y / wave + 0.37 * n, z / wave - 0.61 * n, salt * 16 + n)
    return float(total * 1.2 / np.sqrt(norm))


@nb.njit(cache=True, nogil=True)
def appearance(
    places_m: npt.NDArray[np.float64], material: npt.NDArray[np.uint8], blur_m: npt.NDArray[np.float64],
    looks: npt.NDArray[np.float64], bands: npt.NDArray[np.int64], out: npt.NDArray[np.float64],
) -> None:  # fmt: skip
    """Albedo, or degrees, of places.

    Parameters
    ----------
    places_m : shape (n, 3)
    material : shape (n,)
    blur_m : shape (n,)
        Width of a pixel there.
    looks : `TABLE_OF_LOOKS`
    bands : shape (b,)
        Numbers of `BANDS`.
    out : shape (n, b)
        Filled.
    """
    many = (looks.shape[1] - 1) // 2
    for n in range(len(places_m)):
        x, y, z = places_m[n]
        m = material[n]
        contrast = looks[m, 2 * many]
        lump, vigour = 0.0, 1.0
        if contrast > 0.0:
            lump = _pattern(x, y, z, m, blur_m[n])
            slow = _lumps(x / _VIGOUR_M, y / _VIGOUR_M, z / _VIGOUR_M, 900 + m)
            vigour = min(max(0.6 + 1.2 * slow + 0.3 * lump, 0.0), 1.0)
        for b in range(len(bands)):
            band = bands[b]
            value = vigour * looks[m, band] + (1.0 - vigour) * looks[m, many + band]
            out[n, b] = value + 2.0 * lump if band == TEMPERATURE else max(value * (1.0 + contrast * lump), 0.004)


@nb.njit(cache=True, nogil=True)
def light(
    origins_m: npt.NDArray[np.float32], directions: npt.NDArray[np.float64], hits: npt.NDArray[np.int32],
    planes: npt.NDArray[np.float64], material: npt.NDArray[np.uint8], pixel_rad: float, sky: npt.NDArray[np.float64],
    looks: npt.NDArray[np.float64], bands: npt.NDArray[np.int64], out: npt.NDArray[np.float64],
) -> None:  # fmt: skip
    """Light that comes into pixels along their rays: albedo in sun and sky, or degrees; the sky's from rays that meet nothing.

    Parameters
    ----------
    origins_m, directions : shape (n, 3)
        A pixel's rays follow each other.
    hits : shape (n,)
        Triangles, -1 for none.
    planes, material : of all triangles
    pixel_rad : float
        Width of a pixel.
    sky, looks, bands
    out : shape (pixels, b)
        Filled. Rays of a pixel that meet one triangle count as one in their middle.
    """
    many = len(hits) // len(out)
    place, kind, blur = np.empty((1, 3)), np.empty(1, np.uint8), np.empty(1)
    value = np.empty((1, len(bands)))
    for pixel in range(len(out)):
        out[pixel] = 0.0
        for ray in range(pixel * many, (pixel + 1) * many):
            hit = hits[ray]
            if hit < 0:
                for b in range(len(bands)):
                    out[pixel, b] += sky[bands[b]] / many
                continue
            alike, across = _middle(origins_m, directions, hits, planes[hit], (pixel * many, ray, many), place[0])
            if not alike:
                continue
            far = np.sqrt(((place[0] - origins_m[ray]) ** 2).sum())
            kind[0], blur[0] = material[hit], pixel_rad * far
            appearance(place, kind, blur, looks, bands, value)
            normal = planes[hit]
            sunny = (normal[0] * _SUN[0] + normal[1] * _SUN[1] + normal[2] * _SUN[2]) * (-1.0 if across > 0.0 else 1.0)
            shade = _AMBIENT + (1.0 - _AMBIENT) * max(sunny, 0.0)
            for b in range(len(bands)):
                out[pixel, b] += alike / many * value[0, b] * (1.0 if bands[b] == TEMPERATURE else shade)


@nb.njit(cache=True, nogil=True)
def _middle(
    origins_m: npt.NDArray[np.float32], directions: npt.NDArray[np.float64], hits: npt.NDArray[np.int32],
    plane: npt.NDArray[np.float64], which: tuple[int, int, int], place: npt.NDArray[np.float64],
) -> tuple[int, float]:  # fmt: skip
    """How many rays of a pixel meet what this one meets, with the middle of the places; 0 where an earlier one has counted them."""
    first, ray, many = which
    place[:] = 0.0
    alike, across = 0, 0.0
    for n in range(first, first + many):
        if hits[n] != hits[ray]:
            continue
        if n < ray:
            return 0, 0.0
        alike += 1
        distance, across = _distance(plane, origins_m[n], directions[n])
        for axis in range(3):
            place[axis] += np.float64(origins_m[n, axis]) + distance * directions[n, axis]
    place /= alike
    return alike, across


@nb.njit(cache=True, nogil=True)
def _distance(
    plane: npt.NDArray[np.float64], origin: npt.NDArray[np.float32], direction: npt.NDArray[np.float64]
) -> tuple[float, float]:
    """Along a ray to a plane, and the ray's part along the normal."""
    across, off = 0.0, plane[3]
    for axis in range(3):
        across += plane[axis] * direction[axis]
        off -= plane[axis] * np.float64(origin[axis])
    return (off / across if across != 0.0 else 0.0), across


def is_panel(material: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
    """Which materials, shape (n,), are those of reference panels."""
    return np.isin(material, [INDEX[name] for name in INDEX if name.startswith("panel_")])
