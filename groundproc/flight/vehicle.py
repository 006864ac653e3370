"""Of several vehicles on one link, the one that carries the lidar: the one whose gyros move as the lidar's do.

Where the gyros do not tell, the rule aboard stands (`flightlog.vehicles`), and the doubt is said.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from flightlog.errors import SyncError
from groundproc.flight.autopilot import Boot, Vehicle
from groundproc.flight.pairing import likeness
from groundproc.flight.sync import LEAST_PEAK
from groundproc.flight.timeline import LidarRun

CLEARLY: Final = 0.5
"""The best fit may leave at most this share of the motion unexplained that the next one leaves."""


@dataclass(frozen=True, slots=True)
class Score:
    """How well one vehicle fits the lidar.

    Attributes
    ----------
    name : str
        Its addresses.
    peak : float or None
        Normalised correlation of its gyros and the lidar's, of its best boot; None where they cannot be compared.
    reason : str
        Why not.
    """

    name: str
    peak: float | None
    reason: str = ""

    @property
    def text(self) -> str:
        """For people."""
        return f"{self.name}: {self.reason if self.peak is None else f'{self.peak:.2f}'}"


@dataclass(frozen=True, slots=True)
class Choice:
    """Which vehicle was taken.

    Attributes
    ----------
    vehicle : Vehicle
    scores : tuple of Score
        Of all, the one taken first; empty where there is only one.
    notes : tuple of str
        Sentences for whoever reads the results.
    shared : tuple of str
        Addresses that several vehicles share.
    """

    vehicle: Vehicle
    scores: tuple[Score, ...] = ()
    notes: tuple[str, ...] = ()
    shared: tuple[str, ...] = ()

    def described(self) -> list[dict[str, Any]]:
        """The scores for a report."""
        return [{"address": s.name, "gyro_correlation": s.peak, "reason": s.reason} for s in self.scores]


def choose(vehicles: Sequence[Vehicle], runs: Sequence[LidarRun]) -> Choice:
    """Take the vehicle whose gyros fit the lidar's.

    Parameters
    ----------
    vehicles : sequence of Vehicle
        At least one, the one that the rule aboard elects first.
    runs : sequence of LidarRun
    """
    found = [_own(vehicle, runs) for vehicle in vehicles]
    vehicles = [vehicle for vehicle, _ in found]
    notes = [note for _, note in found if note]
    shared = tuple(dict.fromkeys(Vehicle(each.addresses, []).name for each in vehicles if each.shared_by))
    notes += [
        f"several vehicles share the MAVLink id {name}, told apart by the numbers of their messages; give each an id of its own "
        "(SYSID_THISMAV)"
        for name in shared
    ]
    if len(vehicles) == 1:
        return Choice(vehicles[0], notes=tuple(notes))
    scores = [_score(vehicle, runs) for vehicle in vehicles]
    taken, why = _decide(scores)
    order = [taken, *(i for i in range(len(scores)) if i != taken)]
    ranked = tuple(scores[i] for i in order)
    others = " and ".join(score.name for score in ranked[1:])
    told = ", ".join(score.text for score in ranked)
    notes.append(f"{len(scores)} vehicles on the link: {ranked[0].name} is taken, {others} left out, {why} ({told})")
    return Choice(vehicles[taken], ranked, tuple(notes), shared)


def _decide(scores: Sequence[Score]) -> tuple[int, str]:
    """Which vehicle, and why."""
    peaks = [score.peak or 0.0 for score in scores]
    order = sorted(range(len(peaks)), key=lambda i: -peaks[i])
    best, second = peaks[order[0]], peaks[order[1]]
    if best >= LEAST_PEAK and 1.0 - best**2 <= CLEARLY * (1.0 - second**2):
        return order[0], "by how its gyros fit the lidar's"
    if best >= LEAST_PEAK:
        return 0, "as the first that sent attitudes, because the gyros of both fit the lidar's"
    return 0, "as the first that sent attitudes, because no gyros of theirs fit the lidar's; check which one carried it"


def _score(vehicle: Vehicle, runs: Iterable[LidarRun]) -> Score:
    peak, reason = None, "not heard while the lidar ran"
    for run in runs:
        for boot in vehicle.boots:
            try:
                found = likeness(run, boot)
            except SyncError as error:
                reason = str(error)
                continue
            if found is not None:
                peak = max(peak or 0.0, found.height)
    return Score(vehicle.name, peak, "" if peak is not None else reason)


def _own(vehicle: Vehicle, runs: Sequence[LidarRun]) -> tuple[Vehicle, str]:
    """A vehicle without the boots of other addresses whose gyros contradict: they were of another that was heard at another time.

    A boot that goes on under a new address is the same vehicle.
    """
    if len(vehicle.addresses) == 1:
        return vehicle, ""
    changed = f"the autopilot's MAVLink address changed during the flight: {vehicle.name}"
    by_address: dict[tuple[int, int], list[Boot]] = {}
    for boot in vehicle.boots:
        by_address.setdefault((boot.system, boot.component), []).append(boot)
    scores = {address: _score(Vehicle((address,), boots), runs) for address, boots in by_address.items()}
    if max((score.peak or 0.0 for score in scores.values()), default=0.0) < LEAST_PEAK:
        return vehicle, changed
    strangers = {a: s for a, s in scores.items() if s.peak is not None and s.peak < LEAST_PEAK}
    if not strangers:
        return vehicle, changed
    kept = [boot for boot in vehicle.boots if (boot.system, boot.component) not in strangers]
    addresses = tuple(address for address in vehicle.addresses if address not in strangers)
    told = ", ".join(score.text for score in scores.values())
    names = " and ".join(score.name for score in strangers.values())
    return replace(vehicle, addresses=addresses, boots=kept), (
        f"messages of {names} left out: another vehicle, by how its gyros fit the lidar's ({told})"
    )
