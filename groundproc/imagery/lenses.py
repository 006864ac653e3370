"""Lens models as kernels: a ray to a pixel with all its derivatives, and back.

A lens is a vector of `SIZE` numbers: focal length [px], aspect, principal point [px], five coefficients (these nine can be estimated), the
pixel's width [mm], two skews [px], and the farthest that the model can be followed. Coefficients by kind:

RADTAN           k1, k2, p1, p2, k3    Brown (1971) as in OpenCV and Kalibr: distortion applied to the projection.
EQUIDISTANT      k1, k2, k3, k4        Kannala & Brandt (2006), theta (1 + k1 theta^2 + ...): fish-eye of OpenCV and Kalibr.
PHOTOGRAMMETRIC  k1, k2, p1, p2, k3    Brown (1971) as in photogrammetry: corrections of measured coordinates in mm, y up.
POLYNOMIAL       p0, p1, p2, p3        the vendor's fish-eye polynomial of the Sequoia: rho of 2 theta / pi.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

RADTAN: Final = 0
EQUIDISTANT: Final = 1
PHOTOGRAMMETRIC: Final = 2
POLYNOMIAL: Final = 3

FOCAL: Final = 0
ASPECT: Final = 1
PU: Final = 2
PV: Final = 3
COEFFICIENT: Final = 4
FREE: Final = 9
"""So many of the numbers can be estimated."""
PIXEL_MM: Final = 9
SKEW: Final = 10
FARTHEST: Final = 12
SIZE: Final = 13

_STEPS: Final = 30
_CLOSE: Final = 1e-13


@njit(cache=True, nogil=True)
def radial(kind: int, lens: Array, q: float) -> tuple[float, float]:
    """Distorted distance from the axis and its slope; q is the tangent (RADTAN), mm (PHOTOGRAMMETRIC) or the angle [rad]."""
    s = q * q
    if kind == EQUIDISTANT:
        k1, k2, k3, k4 = lens[4], lens[5], lens[6], lens[7]
        return (
            q * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))),
            1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4))),
        )
    if kind == POLYNOMIAL:
        scale = 2.0 / np.pi
        t = q * scale
        return (
            (lens[4] + t * (lens[5] + t * (lens[6] + t * lens[7]))) / scale,
            lens[5] + t * (2.0 * lens[6] + t * 3.0 * lens[7]),
        )
    k1, k2, k3 = lens[4], lens[5], lens[8]
    return q * (1.0 + s * (k1 + s * (k2 + s * k3))), 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * 7.0 * k3))


@njit(cache=True, nogil=True, inline="always")
def _bent(lens: Array, x: float, y: float, sign: float) -> tuple[float, float]:
    """Brown's distortion of (x, y) alone; `sign` as of `brown`."""
    p, q = (lens[6], lens[7]) if sign > 0.0 else (lens[7], lens[6])
    s = x * x + y * y
    factor = 1.0 + s * (lens[4] + s * (lens[5] + s * lens[8]))
    across = x * factor + 2.0 * p * x * y + q * (s + 2.0 * x * x)
    return across, y * factor + p * (s + 2.0 * y * y) + 2.0 * q * x * y


@njit(cache=True, nogil=True)
def brown(lens: Array, x: float, y: float, sign: float, out: Array, jac: Array, jlens: Array) -> None:
    """Brown's distortion of (x, y), its Jacobian and its derivatives by the five coefficients.

    `sign` is +1 with OpenCV's order of p1 and p2 (p1 goes with 2xy in x), -1 with photogrammetry's (p1 goes with r^2 + 2x^2 in x).
    """
    k1, k2, k3 = lens[4], lens[5], lens[8]
    p, q = (lens[6], lens[7]) if sign > 0.0 else (lens[7], lens[6])
    s = x * x + y * y
    factor = 1.0 + s * (k1 + s * (k2 + s * k3))
    slope = 2.0 * (k1 + s * (2.0 * k2 + s * 3.0 * k3))
    out[0], out[1] = _bent(lens, x, y, sign)
    jac[0, 0] = factor + x * x * slope + 2.0 * p * y + 6.0 * q * x
    jac[0, 1] = x * y * slope + 2.0 * p * x + 2.0 * q * y
    jac[1, 0] = jac[0, 1]
    jac[1, 1] = factor + y * y * slope + 6.0 * p * y + 2.0 * q * x
    for i in range(2):
        value = x if i == 0 else y
        jlens[i, 0], jlens[i, 1], jlens[i, 4] = value * s, value * s * s, value * s * s * s
    a, b = (2, 3) if sign > 0.0 else (3, 2)
    jlens[0, a], jlens[1, a] = 2.0 * x * y, s + 2.0 * y * y
    jlens[0, b], jlens[1, b] = s + 2.0 * x * x, 2.0 * x * y


@njit(cache=True, nogil=True)
def distorted(kind: int, lens: Array, ray: Array, out: Array, jac: Array, jlens: Array) -> bool:
    """Where a ray meets the plane at distance 1, distorted; False where the model does not reach.

    Writes the place, shape (2,), its derivatives by the ray, shape (2, 3), and by the coefficients, shape (2, 5). PHOTOGRAMMETRIC: pinhole.
    """
    x, y, z = ray[0], ray[1], ray[2]
    jlens[:] = 0.0
    if kind in (RADTAN, PHOTOGRAMMETRIC):
        if z <= 0.0:
            return False
        a, b = x / z, y / z
        inner = np.zeros((2, 2))
        if kind == RADTAN:
            if a * a + b * b > lens[FARTHEST] * lens[FARTHEST]:
                return False
            brown(lens, a, b, 1.0, out, inner, jlens)
        else:
            out[0], out[1], inner[0, 0], inner[1, 1] = a, b, 1.0, 1.0
        for i in range(2):
            jac[i, 0], jac[i, 1] = inner[i, 0] / z, inner[i, 1] / z
            jac[i, 2] = -(inner[i, 0] * a + inner[i, 1] * b) / z
        return True
    across = np.sqrt(x * x + y * y)
    angle = np.arctan2(across, z)
    if angle > lens[FARTHEST]:
        return False
    distance, slope = radial(kind, lens, angle)
    square = across * across + z * z
    if across < 1e-9 * abs(z):  # on the axis
        _, slope = radial(kind, lens, 0.0)
        out[0], out[1] = slope * x / z, slope * y / z
        jac[0, 0], jac[0, 1], jac[0, 2] = slope / z, 0.0, -slope * x / (z * z)
        jac[1, 0], jac[1, 1], jac[1, 2] = 0.0, slope / z, -slope * y / (z * z)
        return True
    u, v = x / across, y / across
    out[0], out[1] = distance * u, distance * v
    by_angle_x, by_angle_y, by_angle_z = u * z / square, v * z / square, -across / square
    for i in range(2):
        along, aside_x, aside_y = (u, v * v, -u * v) if i == 0 else (v, -u * v, u * u)
        jac[i, 0] = slope * along * by_angle_x + distance * aside_x / across
        jac[i, 1] = slope * along * by_angle_y + distance * aside_y / across
        jac[i, 2] = slope * along * by_angle_z
        power = angle * angle * angle if kind == EQUIDISTANT else np.pi / 2.0
        for j in range(4):
            jlens[i, j] = along * power
            power *= angle * angle if kind == EQUIDISTANT else angle * 2.0 / np.pi
    return True


@njit(cache=True, nogil=True)
def compared(kind: int, lens: Array, ray: Array, pixel: Array, out: Array, by_ray: Array, by_lens: Array) -> bool:
    """Predicted minus measured [px], shape (2,), with derivatives by the ray, shape (2, 3), and by the lens, shape (2, FREE).

    With PHOTOGRAMMETRIC the measured place is corrected and the pinhole's place is predicted, as its users define a residual.
    """
    place, jac, jlens = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 5))
    by_lens[:] = 0.0
    if not distorted(kind, lens, ray, place, jac, jlens):
        return False
    focal, aspect = lens[FOCAL], lens[ASPECT]
    out[0] = focal * place[0] + lens[SKEW] * place[1] + lens[PU] - pixel[0]
    out[1] = focal * aspect * place[1] + lens[SKEW + 1] * place[0] + lens[PV] - pixel[1]
    for j in range(3):
        by_ray[0, j] = focal * jac[0, j] + lens[SKEW] * jac[1, j]
        by_ray[1, j] = focal * aspect * jac[1, j] + lens[SKEW + 1] * jac[0, j]
    by_lens[0, FOCAL], by_lens[1, FOCAL] = place[0], aspect * place[1]
    by_lens[1, ASPECT] = focal * place[1]
    by_lens[0, PU], by_lens[1, PV] = 1.0, 1.0
    if kind != PHOTOGRAMMETRIC:
        for j in range(5):
            by_lens[0, COEFFICIENT + j] = focal * jlens[0, j] + lens[SKEW] * jlens[1, j]
            by_lens[1, COEFFICIENT + j] = focal * aspect * jlens[1, j] + lens[SKEW + 1] * jlens[0, j]
        return True
    millimetre = lens[PIXEL_MM]
    x, y = (pixel[0] - lens[PU]) * millimetre, -(pixel[1] - lens[PV]) * millimetre
    right, inner = np.zeros(2), np.zeros((2, 2))
    brown(lens, x, y, -1.0, right, inner, jlens)
    out[0] += (x - right[0]) / millimetre
    out[1] += -(y - right[1]) / millimetre
    by_lens[0, PU], by_lens[0, PV] = inner[0, 0], -inner[0, 1]
    by_lens[1, PU], by_lens[1, PV] = -inner[1, 0], inner[1, 1]
    for j in range(5):
        by_lens[0, COEFFICIENT + j] = -jlens[0, j] / millimetre
        by_lens[1, COEFFICIENT + j] = jlens[1, j] / millimetre
    return True


@njit(cache=True, nogil=True)
def _undone(lens: Array, sign: float, x: float, y: float, out: Array) -> bool:
    """The place whose Brown distortion is (x, y), by Newton's method."""
    right, jac, unused = np.zeros(2), np.zeros((2, 2)), np.zeros((2, 5))
    out[0], out[1] = x, y
    # begin on the near side of where the model folds
    reach = np.sqrt(x * x + y * y)
    if reach > 0.9 * lens[FARTHEST]:
        out[0], out[1] = 0.9 * x * lens[FARTHEST] / reach, 0.9 * y * lens[FARTHEST] / reach
    for _ in range(_STEPS):
        brown(lens, out[0], out[1], sign, right, jac, unused)
        dx, dy = x - right[0], y - right[1]
        determinant = jac[0, 0] * jac[1, 1] - jac[0, 1] * jac[1, 0]
        if determinant <= 1e-9:
            return False
        step_x = (jac[1, 1] * dx - jac[0, 1] * dy) / determinant
        step_y = (jac[0, 0] * dy - jac[1, 0] * dx) / determinant
        out[0] += step_x
        out[1] += step_y
        if abs(step_x) + abs(step_y) <= _CLOSE * (1.0 + abs(x) + abs(y)):
            return bool(out[0] * out[0] + out[1] * out[1] <= lens[FARTHEST] * lens[FARTHEST])
    return False


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def placed(kind: int, lens: Array, x: float, y: float, z: float) -> tuple[bool, float, float]:
    """Pixel of a ray, as numbers: for millions of points; False where the model does not reach."""
    a, b = 0.0, 0.0
    if kind == RADTAN:
        reached = z > 0.0 and x * x + y * y <= lens[FARTHEST] * lens[FARTHEST] * z * z
        if reached:
            a, b = _bent(lens, x / z, y / z, 1.0)
    elif kind == PHOTOGRAMMETRIC:
        reached, a, b = _corrected(lens, x, y, z)
    else:
        across = np.sqrt(x * x + y * y)
        angle = np.arctan2(across, z)
        reached = angle <= lens[FARTHEST]
        if reached:
            distance, slope = radial(kind, lens, angle)
            share = distance / across if across >= 1e-9 * abs(z) else slope / z
            a, b = share * x, share * y
    return (
        reached,
        lens[FOCAL] * a + lens[SKEW] * b + lens[PU],
        lens[FOCAL] * lens[ASPECT] * b + lens[SKEW + 1] * a + lens[PV],
    )


@njit(cache=True, nogil=True)
def _corrected(lens: Array, x: float, y: float, z: float) -> tuple[bool, float, float]:
    """Where the plane at distance 1 is measured whose corrected place is that of a ray, before focal length and aspect (no skew)."""
    if z <= 0.0:
        return False, 0.0, 0.0
    along, down = lens[FOCAL] * lens[PIXEL_MM], lens[FOCAL] * lens[ASPECT] * lens[PIXEL_MM]
    measured = np.zeros(2)
    if not _undone(lens, -1.0, along * x / z, -down * y / z, measured):
        return False, 0.0, 0.0
    return True, measured[0] / along, -measured[1] / down


@njit(cache=True, nogil=True)
def projected(kind: int, lens: Array, ray: Array, out: Array) -> bool:
    """Pixel of a ray; False where the model does not reach."""
    reached, u, v = placed(kind, lens, ray[0], ray[1], ray[2])
    if reached:
        out[0], out[1] = u, v
    return reached


@njit(cache=True, nogil=True)
def unprojected(kind: int, lens: Array, pixel: Array, out: Array) -> bool:
    """Unit ray of a pixel; False where the model does not reach."""
    focal, aspect = lens[FOCAL], lens[ASPECT]
    place = np.zeros(2)
    if kind == PHOTOGRAMMETRIC:
        millimetre = lens[PIXEL_MM]
        x, y = (pixel[0] - lens[PU]) * millimetre, -(pixel[1] - lens[PV]) * millimetre
        if x * x + y * y > lens[FARTHEST] * lens[FARTHEST]:
            return False
        jac, unused = np.zeros((2, 2)), np.zeros((2, 5))
        brown(lens, x, y, -1.0, place, jac, unused)
        a, b = place[0] / (focal * millimetre), -place[1] / (focal * aspect * millimetre)
    else:
        u, v = pixel[0] - lens[PU], pixel[1] - lens[PV]
        determinant = focal * focal * aspect - lens[SKEW] * lens[SKEW + 1]
        x = (focal * aspect * u - lens[SKEW] * v) / determinant
        y = (focal * v - lens[SKEW + 1] * u) / determinant
        if kind != RADTAN:
            return _of_angle(kind, lens, x, y, out)
        if not _undone(lens, 1.0, x, y, place):
            return False
        a, b = place[0], place[1]
    length = np.sqrt(a * a + b * b + 1.0)
    out[0], out[1], out[2] = a / length, b / length, 1.0 / length
    return True


@njit(cache=True, nogil=True)
def _of_angle(kind: int, lens: Array, x: float, y: float, out: Array) -> bool:
    """Unit ray of a fish-eye's distorted place, by Newton's method held within where the model rises."""
    distance = np.sqrt(x * x + y * y)
    if distance < 1e-15:
        out[0], out[1], out[2] = 0.0, 0.0, 1.0
        return True
    low, high = 0.0, lens[FARTHEST]
    if radial(kind, lens, high)[0] < distance:
        return False
    angle = min(distance, 0.5 * high)
    for _ in range(2 * _STEPS):
        value, slope = radial(kind, lens, angle)
        if value > distance:
            high = angle
        else:
            low = angle
        step = (distance - value) / slope if slope > 0.0 else 0.0
        following = angle + step
        if not low <= following <= high or slope <= 0.0:
            following = 0.5 * (low + high)
        if abs(following - angle) <= _CLOSE:
            angle = following
            break
        angle = following
    sine = np.sin(angle) / distance
    out[0], out[1], out[2] = x * sine, y * sine, np.cos(angle)
    return True


# arrays ---------------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def project_all(kind: int, lens: Array, rays: Array, out: Array, reached: Mask) -> None:
    """Pixels of rays, shape (n, 3), into shape (n, 2)."""
    for i in range(len(rays)):
        reached[i] = projected(kind, lens, rays[i], out[i])
        if not reached[i]:
            out[i] = np.nan


@njit(cache=True, nogil=True)
def unproject_all(kind: int, lens: Array, pixels: Array, out: Array, reached: Mask) -> None:
    """Unit rays of pixels, shape (n, 2), into shape (n, 3)."""
    for i in range(len(pixels)):
        reached[i] = unprojected(kind, lens, pixels[i], out[i])
        if not reached[i]:
            out[i] = np.nan


@njit(cache=True, nogil=True)
def compare_all(
    kind: int, lens: Array, rays: Array, pixels: Array, out: Array, by_ray: Array, by_lens: Array, reached: Mask
) -> None:
    """`compared` for rays, shape (n, 3), and pixels, shape (n, 2)."""
    for i in range(len(rays)):
        reached[i] = compared(kind, lens, rays[i], pixels[i], out[i], by_ray[i], by_lens[i])
