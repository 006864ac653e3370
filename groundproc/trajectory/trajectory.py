"""A trajectory: knots of position and attitude with their sigmas, and poses at any time that they cover.

Between knots the position is a cubic through both ends with their velocities, and the attitude the same in the rotation vector from
knot to knot with the body rates at both ends (a cumulative cubic Hermite spline on SO(3)): continuous in rate, and local, so that one
bad knot disturbs its two neighbours and nothing else.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog.clock import utc_text
from flightlog.errors import CoverageError
from groundproc.geodesy import LocalFrame
from groundproc.machine.aside import aside
from groundproc.numerics.layout import to_read
from groundproc.numerics.rotations import quat_difference, quat_turned
from groundproc.trajectory.covariance import Correlation, chained, scaled, uncorrelated

Array = npt.NDArray[np.float64]

SMOOTH: Final = "cubic"
HOLD: Final = "hold"


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses at asked times.

    Attributes
    ----------
    position_m : ndarray, shape (n, 3)
        INS origin in the local frame (east, north, up).
    quat_local_ins_wxyz : ndarray, shape (n, 4)
    """

    position_m: Array
    quat_local_ins_wxyz: Array


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Knots of a trajectory, in time order.

    Attributes
    ----------
    frame : LocalFrame
        The local frame of the positions.
    time_ns : ndarray of int64, shape (n,)
        UTC, strictly increasing.
    position_m, velocity_m_s : ndarray, shape (n, 3)
        INS origin, east, north, up.
    quat_local_ins_wxyz : ndarray, shape (n, 4)
    rate_rad_s : ndarray, shape (n, 3)
        Body rate in the ins frame.
    sigma_position_m : ndarray, shape (n, 3)
        Standard deviation east, north, up.
    sigma_attitude_rad : ndarray, shape (n, 3)
        Standard deviation of roll, pitch, heading.
    covered : ndarray of bool, shape (n,)
        Whether the interval from each knot to the next is covered; False for the last.
    interpolation : str
        "cubic", or "hold": the nearest knot's pose, as the source does on its 10 ms grid.
    correlation : Correlation, optional
        Of the six errors of a pose, at knots of its own; None: they are taken to be independent.
    datum : ndarray, shape (6, 6), optional
        Covariance of a shift [m] and a turn about the local origin [rad] that all poses share; it is in that of each pose. None: how
        the errors of one pose hang together with those of another is not known.
    """

    frame: LocalFrame
    time_ns: npt.NDArray[np.int64]
    position_m: Array
    velocity_m_s: Array
    quat_local_ins_wxyz: Array
    rate_rad_s: Array
    sigma_position_m: Array
    sigma_attitude_rad: Array
    covered: npt.NDArray[np.bool_]
    interpolation: str = SMOOTH
    correlation: Correlation | None = None
    datum: Array | None = None

    def __len__(self) -> int:
        return len(self.time_ns)

    def part(self, chosen: slice) -> "Trajectory":
        """The knots of a slice; the last one's interval is no longer covered."""
        arrays = {name: getattr(self, name)[chosen] for name in _ARRAYS}
        covered = arrays["covered"].copy()
        covered[-1:] = False
        correlation, time_ns = self.correlation, arrays["time_ns"]
        if correlation is not None and len(time_ns):
            correlation = correlation.between(int(time_ns[0]), int(time_ns[-1]))
        return replace(self, **arrays | {"covered": covered}, correlation=correlation)

    def set_aside(self) -> "Trajectory":
        """The same with its knots in a file, of which is in memory what is read."""
        kept = aside(*(getattr(self, name) for name in _ARRAYS))
        arrays: dict[str, Any] = dict(zip(_ARRAYS, kept, strict=True))
        return replace(self, **arrays)

    def before(self, time_ns: int) -> "Trajectory":
        """The knots up to a time [ns]."""
        return self.part(slice(None, int(np.searchsorted(self.time_ns, time_ns, side="right"))))

    def after(self, time_ns: int) -> "Trajectory":
        """The knots later than a time [ns]."""
        return self.part(slice(int(np.searchsorted(self.time_ns, time_ns, side="right")), None))

    def where_covered(self, time_ns: npt.NDArray[np.int64]) -> tuple[Poses, npt.NDArray[np.bool_]]:
        """Poses at times, shape (n,), and which of them are covered; a pose that is not is left empty.

        Any order will do; time order is fastest.
        """
        times = np.ascontiguousarray(time_ns, np.int64)
        quat, rate = to_read(self.quat_local_ins_wxyz), to_read(self.rate_rad_s)
        place, velocity = to_read(self.position_m), to_read(self.velocity_m_s)
        knots = _Knots(to_read(self.time_ns), to_read(self.covered), place, velocity, quat, rate)
        poses, covered = Poses(np.empty((len(times), 3)), np.empty((len(times), 4))), np.zeros(len(times), np.bool_)
        _interpolate(
            knots, self.interpolation == HOLD, to_read(times), poses.position_m, poses.quat_local_ins_wxyz, covered
        )
        return poses, covered

    def at(self, time_ns: npt.NDArray[np.int64]) -> Poses:
        """Poses at times, shape (n,).

        Raises
        ------
        CoverageError
            A time outside the covered intervals: there is no extrapolation.
        """
        poses, covered = self.where_covered(time_ns)
        if not covered.all():
            first = int(np.asarray(time_ns)[~covered][0])
            raise CoverageError(
                f"trajectory: no pose at {utc_text(first)}; it covers {utc_text(int(self.time_ns[0]))} to "
                f"{utc_text(int(self.time_ns[-1]))}, less its gaps"
            )
        return poses

    def covariance_at(self, time_ns: npt.NDArray[np.int64]) -> Array:
        """Covariance of poses at times, shape (n, 6, 6): east, north, up [m], roll, pitch, heading [rad].

        Sigmas and correlations are interpolated linearly (see `covariance`); a sigma that nobody stated makes its row and column
        not-a-number.

        Raises
        ------
        CoverageError
            A time before the first knot or after the last.
        """
        times = np.asarray(time_ns, np.int64)
        outside = (times < self.time_ns[0]) | (times > self.time_ns[-1])
        if outside.any():
            raise CoverageError(
                f"trajectory: no covariance at {utc_text(int(times[outside][0]))}; it covers {utc_text(int(self.time_ns[0]))} to "
                f"{utc_text(int(self.time_ns[-1]))}"
            )
        seconds, knots_s = (times - self.time_ns[0]) * 1e-9, (self.time_ns - self.time_ns[0]) * 1e-9
        position, attitude = (
            np.stack([np.interp(seconds, knots_s, column) for column in sigma.T], axis=1)
            for sigma in (self.sigma_position_m, self.sigma_attitude_rad)
        )
        matrix = uncorrelated(times).matrix if self.correlation is None else self.correlation.at(times)
        return scaled(matrix, position, attitude)


_ARRAYS: Final = (
    "time_ns", "position_m", "velocity_m_s", "quat_local_ins_wxyz", "rate_rad_s", "sigma_position_m", "sigma_attitude_rad", "covered",
)  # fmt: skip


def joined(parts: Sequence[Trajectory]) -> Trajectory:
    """Trajectories of one frame as one, in the order of their times; what lies between them is not covered.

    Raises
    ------
    CoverageError
        There is none, or they overlap.
    """
    if not parts:
        raise CoverageError("trajectory: no part of it has two poses")
    parts = sorted(parts, key=lambda part: int(part.time_ns[0]))
    for first, second in itertools.pairwise(parts):
        if second.time_ns[0] <= first.time_ns[-1]:
            raise CoverageError(
                f"trajectory: a part ends at {utc_text(int(first.time_ns[-1]))} and the next begins at "
                f"{utc_text(int(second.time_ns[0]))}, expected later"
            )
    arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
    datum = parts[0].datum if len(parts) == 1 else None
    return replace(parts[0], **arrays, correlation=_correlation_of(parts), datum=datum)


def _correlation_of(parts: Sequence[Trajectory]) -> Correlation | None:
    """The correlations of parts that follow each other; None where no part has any."""
    if all(part.correlation is None for part in parts):
        return None
    return chained(
        [
            uncorrelated(part.time_ns[[0, -1]])
            if part.correlation is None
            else part.correlation.between(int(part.time_ns[0]), int(part.time_ns[-1]))
            for part in parts
        ]
    )


class _Knots(NamedTuple):
    """Knots of a `Trajectory` as the kernel takes them; the fields stand there."""

    time_ns: npt.NDArray[np.int64]
    covered: npt.NDArray[np.bool_]
    position_m: Array
    velocity_m_s: Array
    quat: Array
    rate_rad_s: Array


@njit(cache=True, nogil=True)
def _interpolate(
    trajectory: _Knots, hold: bool, times: npt.NDArray[np.int64], out_position: Array, out_quat: Array,
    out_covered: npt.NDArray[np.bool_],
) -> None:  # fmt: skip
    knots, covered, quat, rate = trajectory.time_ns, trajectory.covered, trajectory.quat, trajectory.rate_rad_s
    position, velocity = trajectory.position_m, trajectory.velocity_m_s
    last = len(knots) - 2
    i = -1
    delta, slope, vector = np.empty(3), np.empty(3), np.empty(3)
    for k in range(len(times)):
        t = times[k]
        if last < 0 or t < knots[0] or t > knots[last + 1]:
            continue
        if i < 0 or t < knots[i] or t >= knots[i + 1]:
            # what follows in time order is in the same interval or the next
            if 0 <= i < last and knots[i + 1] <= t < knots[i + 2]:
                i += 1
            else:
                # np.searchsorted would have comparisons of complex numbers compiled
                i, after = 0, last + 1
                while after - i > 1:
                    middle = (i + after) // 2
                    if knots[middle] <= t:
                        i = middle
                    else:
                        after = middle
            quat_difference(quat[i], quat[i + 1], delta)
            # rate of the rotation vector at the end: the inverse right Jacobian, to second order in the step
            w = rate[i + 1]
            slope[0] = w[0] + 0.5 * (delta[1] * w[2] - delta[2] * w[1])
            slope[1] = w[1] + 0.5 * (delta[2] * w[0] - delta[0] * w[2])
            slope[2] = w[2] + 0.5 * (delta[0] * w[1] - delta[1] * w[0])
        if not covered[i]:
            continue
        out_covered[k] = True
        if hold:
            nearest = i if t - knots[i] <= knots[i + 1] - t else i + 1
            out_position[k], out_quat[k] = position[nearest], quat[nearest]
            continue
        span = (knots[i + 1] - knots[i]) * 1e-9
        u = (t - knots[i]) * 1e-9 / span
        h10 = u * (1 - u) * (1 - u) * span
        h01 = u * u * (3 - 2 * u)
        h11 = u * u * (u - 1) * span
        for axis in range(3):
            out_position[k, axis] = (
                (1 - h01) * position[i, axis]
                + h01 * position[i + 1, axis]
                + h10 * velocity[i, axis]
                + h11 * velocity[i + 1, axis]
            )
            vector[axis] = h01 * delta[axis] + h10 * rate[i, axis] + h11 * slope[axis]
        quat_turned(quat[i], vector[0], vector[1], vector[2], out_quat[k])
