"""The finished adjustment of one run of the lidar's clock: path, mount, lasers, covariance, self-check and report."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.mount import Mount
from groundproc.estimation.adjustment.bridging import along_untold_s, bridged, holds_somewhere, loose, stretches, unheld
from groundproc.estimation.adjustment.joining import Joined
from groundproc.estimation.adjustment.sensorpath import lost, of_ins
from groundproc.estimation.adjustment.windows import (
    Sources,
    Window,
    corrections_over,
    unseen,
)
from groundproc.estimation.method import Given
from groundproc.estimation.observations.fixes import SLID, SLID_SIGMAS
from groundproc.estimation.observations.lasers import Corrections
from groundproc.estimation.observations.lidar import plane_warnings
from groundproc.estimation.observations.observation import Outcome
from groundproc.estimation.observations.rows import H, turned
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.motion import Motion
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.track import Track
from groundproc.sensors.lasers import LaserCorrections
from groundproc.trajectory.covariance import Correlation, correlation_of, scaled
from groundproc.trajectory.estimate import MountSigma
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

UNSETTLED_M: Final = 0.03
"""A last step larger than this is worth a warning."""
UNTOLD_S: Final = 10.0
"""So long with one direction of the way missing is worth a warning: over less, inertial data between two good ends keep decimetres."""


@dataclass(slots=True)
class Run:
    """The adjustment of one run of the lidar's clock: its windows, and the path joined of them.

    Attributes
    ----------
    windows : list of Window
    path : Path
    track : Track
    motion : Motion
    sources : Sources
    joined : Joined or None
        What the windows' joining found, where there is more than one.
    refuted : bool
        Whether what it began from agrees with the fixes and goes another way (`refuting`).
    """

    SIGMA_SOURCE: ClassVar = (
        "posterior of the adjustment: what surfaces, the gyro between knots, lasting errors of the inertial units, GNSS and compass do "
        "to the solution; absolute position and heading are those of control, outside positions, GNSS and compass"
    )

    windows: list[Window]
    path: Path
    track: Track
    motion: Motion
    sources: Sources
    joined: Joined | None = None
    refuted: bool = False

    def estimates(self) -> dict[str, tuple[Array, Array]]:
        """Globals over all windows: mean by their variances, and its sigma; what the joining found is that."""
        found = {}
        for name in self.windows[0].values:
            values = np.array([window.values[name][0] for window in self.windows])
            weights = np.array([window.values[name][1] for window in self.windows]) ** -2.0
            found[name] = ((weights * values).sum(axis=0) / weights.sum(axis=0), weights.sum(axis=0) ** -0.5)
        for name, more in unseen(found, self.sources.mat_ins_lidar).items():
            if name in found:
                found[name] = found[name][0], np.hypot(found[name][1], more)
        return found if self.joined is None else found | self.joined.values

    def mount(self, nominal: Mount) -> Mount:
        """The mount as estimated; the nominal one where the trajectory is what the run began from, which was made with it."""
        if not self.estimates_mount():
            return nominal
        values = self.estimates()
        mat = nominal.mat_ins_lidar() @ turned(-values["ins.turn"][0])
        heading, pitch, roll = (float(np.rad2deg(a[0])) for a in frames.attitude_of(mat[None]))
        lever = nominal.lidar_position_m()
        if "ins.lever" in values:
            lever = -mat @ values["ins.lever"][0]
        return nominal.with_lidar(
            yaw_deg=(180.0 - heading) % 360.0 - 180.0, pitch_deg=pitch, roll_deg=roll, position_m=_three(lever)
        )

    def corrections(self) -> Corrections | None:
        """Those of the lasers; None where they were not asked for."""
        told = corrections_over(self.windows)
        return None if told is None else Corrections(*told)

    def mount_source(self, nominal: str) -> str:
        """Where the mount comes from; `nominal` is where that came from which it began with."""
        return f"estimated by adjusted, begun from {nominal}" if self.estimates_mount() else nominal

    def mount_sigma(self, nominal: Mount) -> MountSigma | None:
        """How well the mount is known: the turn about the sensor's axes, the lever arm in the ins frame."""
        if not self.estimates_mount():
            return None
        values = self.estimates()
        turn, lever = values["ins.turn"][1], None
        if "ins.lever" in values:
            square = np.square(self.mount(nominal).mat_ins_lidar()) @ np.square(values["ins.lever"][1])
            lever = _three(np.sqrt(square))
        return MountSigma(_three(turn), lever)

    def estimates_mount(self) -> bool:
        """Whether the mount is estimated: it is not without the autopilot's gyro, nor where what the run began from is used."""
        return "ins.turn" in self.windows[0].values and not self.is_worse()

    def lasers(self, nominal: LaserCorrections, count: int) -> LaserCorrections:
        """Corrections of the sensor's lasers, so many, as estimated, or as they were given."""
        found = self.corrections()
        return nominal if found is None or self.is_worse() else found.file(count)

    def trajectory(self, given: Given, mount: Mount) -> Trajectory:
        """The path as that of the ins frame, with the posterior's sigmas."""
        position, attitude, correlation = (
            np.concatenate([getattr(w, name)[: w.own + (w is self.windows[-1])] for w in self.windows])
            for name in ("sigma_position_m", "sigma_attitude_rad", "correlation")
        )
        if self.joined is not None:
            count = len(position)
            whole = self.joined.sigma_position_m[:count], self.joined.sigma_attitude_rad[:count]
            covariance = scaled(correlation, position, attitude) + scaled(self.joined.correlation[:count], *whole)
            position, attitude = np.hypot(position, whole[0]), np.hypot(attitude, whole[1])
            correlation = correlation_of(np.arange(count), covariance).matrix
        grid, knots = np.arange(len(self.path.quat)), np.arange(len(position)) * STEPS
        sigmas = (np.stack([np.interp(grid, knots, axis) for axis in part.T], axis=1) for part in (position, attitude))
        made = of_ins(self.path, self.motion, given.frame, mount, *sigmas)
        datum = self.windows[0].datum if self.joined is None else self.joined.datum
        return replace(made, correlation=Correlation(made.time_ns[knots], correlation), datum=datum)

    def warnings(self) -> list[str]:
        """What the self-check found, a sentence each."""
        found = lost(self.track)
        found += plane_warnings(self.outcome())
        moved = max(
            log[-1]["moved_m"] for log in [w.log for w in self.windows] + ([self.joined.log] if self.joined else [])
        )
        # a path that is not handed back need not settle
        if moved > UNSETTLED_M and not self.is_blind():
            found.append(
                f"the last step still moved the path by {moved * 1e3:.1f} mm, expected under {UNSETTLED_M * 1e3:.0f}; it has not settled"
            )
        found += self._untold()
        outcome = self.outcome()
        # several legs have one and the same thing to say
        said = dict.fromkeys(sentence for each in self.sources.observations for sentence in each.warnings(outcome))
        return [*found, *said]

    def _untold(self) -> list[str]:
        """One sentence where the lidar leaves one direction of the way open for long, and nothing better than GNSS tells it."""
        seconds = along_untold_s(self.track)
        if seconds < UNTOLD_S or self.is_worse() or self.sources.leads():
            return []
        sentence = (
            f"for {seconds:.0f} s on end the lidar does not tell one direction of the way, as along plain walls or a bank: there the path "
            "has it from inertial sensors and GNSS and may be metres off along it; --positions of a better receiver would hold it"
        )
        return [sentence]

    def outcome(self) -> Outcome:
        """What came of it, for the observations to report on."""
        told = [window.told for window in self.windows] if self.joined is None else [self.joined.told]
        return Outcome(self.path, [window.log[-1] for window in self.windows], told, self.is_misled())

    def blind_s(self) -> float:
        """Seconds in which the lidar does not hold the path, the first one left out: there is no map yet."""
        return float(unheld(self.track).sum() * H)

    def is_blind(self) -> bool:
        """Whether the lidar held nothing for long anywhere: without better positions it then knows no more than what it began from."""
        return not holds_somewhere(self.track) and not self.sources.leads()

    def slid_sigmas(self) -> float:
        """How far the path slid away from the fixes within `DRIFT_S`, in sigmas of such a mean."""
        return max(window.log[-1].get(SLID, 0.0) for window in self.windows)

    def is_misled(self) -> bool:
        """Whether the path goes where the fixes do not, and either the odometry lost its way or what it began from says so too."""
        return (self.track.restarts > 0 or self.refuted) and self.slides() and not self.sources.leads()

    def slides(self) -> bool:
        """Whether the path slides away from the fixes that it believes."""
        return self.slid_sigmas() > SLID_SIGMAS

    def is_worse(self) -> bool:
        """Whether what the adjustment began from is better than what it made of it."""
        return self.is_blind() or self.is_misled()

    def bridged(self, made: Trajectory, begun: Trajectory) -> Trajectory:
        """A trajectory of this run with the motion of what it began from where the lidar sees nothing that tells the way."""
        if self.sources.leads():
            return made
        return bridged(made, begun, stretches(loose(self.track), int(self.path.start_ns)))

    def note(self) -> str:
        """What a reader must know though nothing is wrong."""
        if self.is_misled():
            return "the lidar misled the adjustment: the trajectory is what it began from"
        if self.is_blind():
            return "nowhere does the lidar see for long what tells the way: the trajectory is what the adjustment began from"
        blind, whole = self.blind_s(), len(self.track) * H
        if blind <= 0.02 * whole:
            return ""
        return (
            f"{blind:.1f} s of {whole:.1f} s without planes or leaves to hold on to: there the path is the inertial sensors' "
            "and the GNSS's, and its sigma says so"
        )

    def report(self, nominal: Mount) -> dict[str, Any]:
        """What stands in quality.json."""
        values: dict[str, Any] = {}
        corrections, known = self.corrections(), self.windows[0].unknowns
        for name, (value, sigma) in self.estimates().items():
            unit = known.unit[name]
            scale = float(np.rad2deg(1.0)) if unit.startswith("deg") else 1.0
            prior = known.sigma[name]
            values[f"{name}_{unit}" if unit else name] = {
                "value": ((value + self.sources.known.get(name, 0.0)) * scale).tolist(),
                "sigma": (sigma * scale).tolist(),
                "prior_sigma": (prior * scale).tolist(),
                "held": (sigma > 0.7 * prior).tolist(),
            }
        mount = self.mount(nominal)
        return {
            "note": self.note(),
            "seconds": len(self.track) * H,
            "blind_s": self.blind_s(),
            "restarts": self.track.restarts,
            "rejoined": self.track.rejoined,
            "apart": self.track.apart,
            "loops": [
                loop | {name: loop[name] + window.first * H for name in ("seen_s", "again_s")}
                for window in self.windows
                for loop in window.loops
            ],
            "beside": sum(window.beside for window in self.windows),
            "windows": [
                {"start_s": w.first * H, "seconds": (w.last - w.first) * H, "rounds": w.log} for w in self.windows
            ],
            "joining": None if self.joined is None else self.joined.report(),
            "estimated": values,
            **self._observed(),
            **({} if corrections is None else {"lasers": corrections.report()}),
            "mount_change": {
                "yaw_pitch_roll_deg": [
                    (getattr(mount.lidar, name) - getattr(nominal.lidar, name) + 180.0) % 360.0 - 180.0
                    for name in ("yaw_deg", "pitch_deg", "roll_deg")
                ],
                "position_m": (mount.lidar_position_m() - nominal.lidar_position_m()).tolist(),
            },
        }

    def _observed(self) -> dict[str, Any]:
        """What the observations report: lists of several under one name are put together."""
        outcome = self.outcome()
        told: dict[str, Any] = {"control": None, "outside": []}
        for each in self.sources.observations:
            for name, said in each.report(outcome).items():
                told[name] = told.get(name, []) + said if isinstance(said, list) else said
        return told


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
