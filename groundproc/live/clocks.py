"""The autopilot's clock on the lidar's while both run: receive times at first, the gyros as soon as they can tell."""

import threading
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import nmea
from flightlog.constants import NS_PER_S
from flightlog.errors import SwathError
from flightlog.mavlink import Frame
from groundproc.flight import pairing, timebase
from groundproc.flight.positionpackets import Sentence
from groundproc.flight.sync import GyroTrack
from groundproc.flight.timeline import Leg, LidarRun
from groundproc.live.telemetry import newest_boot

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

FIRST_S: Final = 3.0
"""Both clocks must have been heard for so long before receive times tie them."""
GYRO_S: Final = 20.0
"""From here on the gyros are asked."""
SOON_S: Final = 10.0
LATER_S: Final = 30.0
_PAIRS: Final = 6000


@dataclass(frozen=True, slots=True)
class Tie:
    """The autopilot's clock and UTC from the lidar's.

    Attributes
    ----------
    method : str
        "gyro" or "host".
    sigma_ns : float
    offset_ns, reference_ns : int
    drift : float
        Autopilot = lidar + offset + drift (lidar - reference).
    utc_offset_ns : int
        UTC minus lidar time.
    utc_source : str
    axes : ndarray, shape (3, 3), or None
        Signed permutation that the lidar's gyro axes need beyond the manual's, where the gyros say that one does.
    note : str
    """

    method: str
    sigma_ns: float
    offset_ns: int
    reference_ns: int
    drift: float
    utc_offset_ns: int
    utc_source: str
    axes: Array | None
    note: str

    def lidar_ns(self, boot_ns: Times) -> Times:
        """Lidar time [ns] of boot times, shape (n,)."""
        since = boot_ns - self.offset_ns - self.reference_ns
        return np.asarray(self.reference_ns + np.rint(since / (1.0 + self.drift)).astype(np.int64))


def tie_of(leg: Leg, mat_ins_lidar: Array, now_ns: int) -> Tie:
    """What a leg says at a lidar time [ns]."""
    found, axes = leg.sync, None
    if found.mat_ins_lidar is not None:
        near = np.rint(mat_ins_lidar.T @ found.mat_ins_lidar)
        if np.array_equal(np.abs(near) @ np.ones(3), np.ones(3)) and np.array_equal(
            np.ones(3) @ np.abs(near), np.ones(3)
        ):
            axes = near
    utc_ns = int(leg.utc_from_lidar(np.array([now_ns]))[0])
    return Tie(
        found.method, found.sigma_offset_ns, found.offset_ns, found.reference_ns, found.drift_ppm * 1e-6, utc_ns - now_ns,
        leg.utc.source, axes, found.note,
    )  # fmt: skip


class LidarTimes:
    """Pairs of lidar time and receive time of the last minute or so, and the GPS sentences of the lidar's own receiver."""

    def __init__(self) -> None:
        self._pairs: deque[tuple[int, int]] = deque(maxlen=_PAIRS)
        self._fixes: deque[tuple[int, nmea.Rmc]] = deque(maxlen=120)

    def add(self, device_ns: int, receive_ns: int) -> None:
        """Take one packet's times [ns]."""
        self._pairs.append((device_ns, receive_ns))

    def hear(self, sentences: list[Sentence]) -> None:
        """Take sentences of the lidar's GPS."""
        for sentence in sentences:
            fix = nmea.parse_rmc(sentence.text)
            if fix is not None:
                self._fixes.append((sentence.device_time_ns, fix))

    @property
    def span_s(self) -> float:
        """Seconds covered."""
        return (self._pairs[-1][0] - self._pairs[0][0]) / NS_PER_S if self._pairs else 0.0

    def run(self, gyro: GyroTrack | None) -> LidarRun | None:
        """What the synchronisation of recorded flights takes; None where nothing was heard."""
        if len(self._pairs) < 2:
            return None
        device, receive = np.array(self._pairs, np.int64).T
        line = timebase.host_line(device, receive)
        return LidarRun(int(receive[0]), int(receive[-1]), line, gyro, tuple(self._fixes))


class _Search(threading.Thread):
    """One search; `found` is a tie, or why there is none, once it has ended."""

    def __init__(self, run: LidarRun, frames: list[Frame], mat_ins_lidar: Array, how: str) -> None:
        super().__init__(name="sync", daemon=True)
        self.found: Tie | str = ""
        self._run, self._frames, self._mat, self._how = run, frames, mat_ins_lidar, how

    def run(self) -> None:
        boot = newest_boot(self._frames)
        if boot is None:
            self.found = "no heartbeat of an autopilot"
            return
        try:
            leg = pairing.legs([self._run], [boot], self._mat, self._how)[0]
            self.found = tie_of(leg, self._mat, self._run.line.device_ns(self._run.last_receive_ns))
        except (SwathError, np.linalg.LinAlgError) as error:
            self.found = str(error)


class Synchroniser:
    """Finds ties, the expensive ones in a thread of their own so that the odometry never waits.

    Parameters
    ----------
    mat_ins_lidar : ndarray, shape (3, 3)
        Of the mount.
    """

    def __init__(self, mat_ins_lidar: Array) -> None:
        self.tie: Tie | None = None
        self.trouble = ""
        self._mat = mat_ins_lidar
        self._search: _Search | None = None
        self._next_s = 0.0

    def is_due(self, now_s: float) -> bool:
        """Whether to begin a search; `now_s` is any clock that goes on."""
        return self._search is None and now_s >= self._next_s

    def begin(self, now_s: float, times: LidarTimes, gyro: GyroTrack | None, frames: list[Frame]) -> None:
        """Begin a search with what was heard so far."""
        self._next_s = now_s + 0.5
        run = times.run(gyro)
        if run is None or times.span_s < FIRST_S:
            return
        if self.tie is None:
            # receive times are quick, and everything waits for them
            self._search = _Search(run, frames, self._mat, "host")
            self._search.run()
        else:
            self._search = _Search(run, frames, self._mat, "auto")
            self._search.start()

    def collect(self, now_s: float) -> bool:
        """Take what a search has found; whether there is a new tie."""
        if self._search is None or self._search.is_alive():
            return False
        found, self._search = self._search.found, None
        first = self.tie is None
        self.trouble = found if isinstance(found, str) else ""
        # receive times never replace what the gyros said
        if isinstance(found, str) or (self.tie is not None and self.tie.method == "gyro" and found.method != "gyro"):
            if not first:
                self._next_s = now_s + SOON_S
            return False
        self.tie = found
        self._next_s = now_s + (GYRO_S - FIRST_S if first else LATER_S if found.method == "gyro" else SOON_S)
        return True

    def forget(self) -> None:
        """The autopilot's clock has begun anew: what a search that still runs will find is void, nobody waits for it."""
        self.tie, self._next_s, self._search = None, 0.0, None

    def wait(self) -> None:
        """Let a search that runs end."""
        if self._search is not None and self._search.is_alive():
            self._search.join(10.0)
