"""All clocks of a log on one scale: UTC where lidar and autopilot can be tied, else log time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import ClockError, SyncError
from flightlog.mount import Mount
from groundproc.flight import timebase
from groundproc.flight.autopilot import Boot
from groundproc.flight.pairing import legs
from groundproc.flight.timebase import HostLine
from groundproc.flight.timeline import ClockTie, LidarRun, Line, tied, ties_of

Times = npt.NDArray[np.int64]

UTC: Final = "UTC"
LOG: Final = "log time"


@dataclass(frozen=True, slots=True)
class Pilot:
    """One boot of the autopilot and its clock.

    Attributes
    ----------
    boot : Boot
    to_scale : callable
        From boot time to the scale [ns], shape (n,).
    """

    boot: Boot
    to_scale: Callable[[Times], Times]


@dataclass(frozen=True, slots=True)
class Scale:
    """The clocks of a flight.

    Attributes
    ----------
    name : str
        `UTC` or `LOG`.
    note : str
        Why it is log time; empty where it is not.
    lidar : tuple of ClockTie
        Lines from lidar time to the scale, one for each run of its clock.
    pilots : tuple of Pilot
    boots_without : int
        Boots of the autopilot that go with no run of the lidar; what they said is left out.
    """

    name: str
    note: str
    lidar: tuple[ClockTie, ...]
    pilots: tuple[Pilot, ...]
    boots_without: int = 0


def scale_of(runs: Sequence[LidarRun], boots: Sequence[Boot], mount: Mount, ties: Sequence[ClockTie] = ()) -> Scale:
    """Tie the clocks.

    Parameters
    ----------
    runs, boots : sequences
        Of the lidar's clock and of the autopilot; of the latter there may be none.
    mount : Mount
    ties : sequence of ClockTie
        Of a trajectory that goes with the log: its scale is UTC, and it must be hit.

    Raises
    ------
    ClockError
        Clocks cannot be tied, or not to `ties`, and a trajectory needs that.
    """
    if not boots:
        return _by_log(runs, (), "the log has no autopilot")
    try:
        timeline = legs(runs, boots, mount.mat_ins_lidar(), "auto")
    except (ClockError, SyncError) as error:
        if ties:
            raise
        return _by_log(runs, boots, str(error))
    if ties:
        timeline = tied(timeline, ties)
    first = {leg.boot.number: leg for leg in reversed(timeline)}
    pilots = tuple(Pilot(leg.boot, leg.utc_from_boot) for _, leg in sorted(first.items()))
    return Scale(UTC, "", ties_of(timeline), pilots, len(boots) - len(pilots))


def _by_log(runs: Sequence[LidarRun], boots: Sequence[Boot], why: str) -> Scale:
    """Each clock by its receive times: right to the delays of its messages."""
    lidar = tuple(ClockTie(run.first_receive_ns, run.last_receive_ns, (_line(run.line),), "host") for run in runs)
    pilots = []
    for boot in boots:
        boot_ns, host_ns = boot.host_pairs()
        if len(boot_ns) >= 2:
            pilots.append(Pilot(boot, _line(timebase.host_line(boot_ns, host_ns))))
    return Scale(LOG, why, lidar, tuple(pilots), len(boots) - len(pilots))


def _line(host: HostLine) -> Line:
    return Line(host.offset_ns, host.drift_ppm * 1e-6, host.reference_ns)
