"""Method `adjusted`: the whole flight in one adjustment of lidar, inertial sensors, GNSS and compass.

packets --slices--> clusters --odometry--> path --batch--> path, mount, clocks, biases, compass; and the sigma of each.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter1d

from flightlog import frames
from flightlog.errors import LogError
from flightlog.mount import Mount
from groundproc.adjustment.anchors import Attitudes, Positions
from groundproc.adjustment.batch import DRAWS, Batch, Posterior, make_unit, turned
from groundproc.adjustment.factors import H, Unit
from groundproc.adjustment.motion import ImuTrack, Motion, base_motion, on_grid
from groundproc.adjustment.scans import STEP_NS, STEPS, slices
from groundproc.adjustment.spline import Path
from groundproc.adjustment.track import Track, Tracker, follow, grid_ns
from groundproc.geodesy import LocalFrame
from groundproc.timeline import Leg
from groundproc.trajectory import ins
from groundproc.trajectory.method import Estimate, Given, Progress
from groundproc.trajectory.trajectory import Trajectory, joined

Array = npt.NDArray[np.float64]

POSITION_TAU_S: Final = 60.0
POSITION_WHITE_M: Final = 0.1
"""Errors of a GNSS receiver that smooths: they last for a minute, and a tenth of a metre is new each second."""
LEAST_POSITION_SIGMA_M: Final = 0.02
ATTITUDE_SIGMA_RAD: Final = np.deg2rad([1.0, 1.0, 2.0])
ATTITUDE_TAU_S: Final = 10.0
"""Of an AHRS of the APM class: tilt, and heading beyond the compass's curve; its errors last for the time of its own filter."""


def estimate(given: Given, progress: Progress, start: Trajectory) -> Estimate:
    """Adjust every run of the lidar's clock.

    Parameters
    ----------
    given : Given
    progress : Progress
    start : Trajectory
        Rough poses of the ins frame over the flight.

    Raises
    ------
    LogError
        No run has lidar, inertial data and positions together.
    """
    made: list[Run | CausalRun] = []
    reasons: list[LogError] = []
    adjust = causal_run if given.survey.causal else adjust_run
    for number in sorted({leg.run for leg in given.placed}):
        legs = [leg for leg in given.placed if leg.run == number]
        try:
            made.append(adjust(given, legs, number, start, progress))
        except LogError as error:
            reasons.append(error)
    if not made:
        raise reasons[0]
    main = max(made, key=lambda run: len(run.path.quat))
    mount = main.mount(given.mount)
    warnings = [w for run in made for w in run.warnings()] + [str(reason) for reason in reasons]
    return Estimate(
        joined([run.trajectory(given, mount) for run in made]),
        mount,
        main.SIGMA_SOURCE,
        report=main.report(given.mount),
        warning="; ".join(warnings),
    )


@dataclass(slots=True)
class Run:
    """The adjustment of one run of the lidar's clock.

    Attributes
    ----------
    path : Path
    batch : Batch
    draws : ndarray, shape (DRAWS, unknowns)
    posterior : Posterior
    track : Track
    motion : Motion
    """

    SIGMA_SOURCE: ClassVar = (
        "posterior of the adjustment: draws from it, with the lidar's information divided by 4 because neighbouring returns share "
        "errors; absolute position and heading are the GNSS's and the compass's"
    )

    path: Path
    batch: Batch
    draws: Array
    posterior: Posterior
    track: Track
    motion: Motion

    def ins_unit(self) -> Unit | None:
        """The autopilot's unit."""
        return next((unit for unit in self.batch.units if unit.name == "ins"), None)

    def mount(self, nominal: Mount) -> Mount:
        """The mount as estimated."""
        unit = self.ins_unit()
        if unit is None:
            return nominal
        mat = nominal.mat_ins_lidar() @ turned(-unit.values["turn"])
        heading, pitch, roll = (float(np.rad2deg(a[0])) for a in frames.attitude_of(mat[None]))
        lever = -mat @ unit.values["lever"]
        x, y, z = (float(v) for v in lever)
        return nominal.with_lidar(yaw_deg=-heading, pitch_deg=pitch, roll_deg=roll, position_m=(x, y, z))

    def trajectory(self, given: Given, mount: Mount) -> Trajectory:
        """The path as that of the ins frame, with the posterior's sigmas."""
        sigmas = self._sigmas(mount.mat_ins_lidar(), mount.lidar_position_m())
        return of_ins(self.path, self.motion, given.frame, mount, *sigmas)

    def _sigmas(self, mat_ins_lidar: Array, lever: Array) -> tuple[Array, Array]:
        """Sigmas of position and of roll, pitch, heading on the grid."""
        path, unknowns = self.path, self.posterior.unknowns
        quat, place = path.quat[::STEPS], path.position_m[::STEPS]
        mats = frames.mat_from_quat(quat)
        to_ins = -mat_ins_lidar.T @ lever
        squares_position, squares_attitude = np.zeros((len(quat), 3)), np.zeros((len(quat), 3))
        heading = frames.attitude_of(mats @ mat_ins_lidar.T)[0]
        right = np.stack([np.cos(heading), -np.sin(heading)], axis=1)
        ahead = np.stack([np.sin(heading), np.cos(heading)], axis=1)
        for draw in self.draws:
            part = {name: draw[where] for name, where in unknowns.names.items()}
            spline = draw[: unknowns.path_size].reshape(-1, 6)
            at = (spline[:-2] + 4.0 * spline[1:-1] + spline[2:]) / 6.0
            in_body = at[:, :3] + part.get("ins.turn", np.zeros(3))
            turn = np.einsum("nij,nj->ni", mats, in_body) + part["world.turn"]
            arm = np.cross(at[:, :3], to_ins) + part.get("ins.lever", np.zeros(3))
            moved = at[:, 3:] + np.cross(part["world.turn"], place) + part["world.shift"]
            squares_position += np.square(moved + np.einsum("nij,nj->ni", mats, arm))
            squares_attitude += np.square(
                np.stack([(turn[:, :2] * ahead).sum(axis=1), (turn[:, :2] * right).sum(axis=1), turn[:, 2]], axis=1)
            )
        # what the gyro adds between two knots, the mean of a Brownian bridge
        bridge = self.motion.rate_density**2 * H / 6.0
        smooth = [
            uniform_filter1d(s / len(self.draws), 11, axis=0, mode="nearest")
            for s in (squares_position, squares_attitude)
        ]
        grid, knots = np.arange(len(path.quat)), np.arange(len(quat)) * STEPS
        position, attitude = (
            np.stack([np.interp(grid, knots, axis) for axis in variance.T], axis=1) for variance in smooth
        )
        return np.sqrt(position), np.sqrt(attitude + bridge)

    def warnings(self) -> list[str]:
        """What the self-check found, a sentence each."""
        found, last = lost(self.track), self.batch.log[-1]
        if last["chi_square"] > 3.0:
            found.append(
                f"the lidar's residuals are {last['chi_square']:.1f} times what their noise explains, expected 1; the cloud may be doubled"
            )
        if last.get("position_rms", 0.0) > 4.0:
            found.append(
                f"the path differs from the GNSS positions by {last['position_rms']:.1f} sigma, expected 1; one of them is wrong"
            )
        return found

    def blind_s(self) -> float:
        """Seconds in which the lidar saw next to no planes, the first one left out: there is no map yet."""
        return float(sum(m < 50 for m in self.track.matched[10:]) * H)

    def note(self) -> str:
        """What a reader must know though nothing is wrong."""
        blind, whole = self.blind_s(), len(self.track) * H
        if blind <= 0.02 * whole:
            return ""
        return (
            f"{blind:.1f} s of {whole:.1f} s without planes to hold on to: there the path is the inertial sensors' and the GNSS's, "
            "and its sigma says so"
        )

    def report(self, nominal: Mount) -> dict[str, Any]:
        """What stands in quality.json."""
        names = self.posterior.unknowns.names
        sigma = {name: np.sqrt(np.mean(np.square(self.draws[:, where]), axis=0)) for name, where in names.items()}
        values: dict[str, Any] = {}
        for unit in self.batch.units:
            for name, value in unit.values.items():
                key = f"{unit.name}.{name}"
                if key in names:
                    scale = np.rad2deg(1.0) if name in ("bias", "turn") else 1.0
                    values[key + _UNITS[name]] = {
                        "value": (value * scale).tolist(),
                        "sigma": (sigma[key] * scale).tolist(),
                        "prior": (self.posterior.unknowns.sigma[key] * scale).tolist(),
                    }
        values["compass_deg"] = {
            "terms": ["constant", "sin h", "cos h", "sin 2h", "cos 2h"],
            "value": np.rad2deg(self.batch.compass).tolist(),
            "sigma": np.rad2deg(sigma["compass"]).tolist(),
        }
        mount = self.mount(nominal)
        return {
            "note": self.note(),
            "seconds": len(self.track) * H,
            "blind_s": self.blind_s(),
            "restarts": self.track.restarts,
            "rounds": self.batch.log,
            "estimated": values,
            "mount_change": {
                "yaw_pitch_roll_deg": [
                    mount.lidar.yaw_deg - nominal.lidar.yaw_deg,
                    mount.lidar.pitch_deg - nominal.lidar.pitch_deg,
                    mount.lidar.roll_deg - nominal.lidar.roll_deg,
                ],
                "position_m": (mount.lidar_position_m() - nominal.lidar_position_m()).tolist(),
            },
        }


def of_ins(
    path: Path, motion: Motion, frame: LocalFrame, mount: Mount, sigma_position_m: Array, sigma_attitude_rad: Array
) -> Trajectory:
    """The path of the sensor as the trajectory of the ins frame; sigmas on its grid."""
    mat_ins_lidar, lever = mount.mat_ins_lidar(), mount.lidar_position_m()
    back = frames.quat_from_mat(mat_ins_lidar.T[None])
    quat = frames.quat_multiply(path.quat, np.repeat(back, len(path.quat), axis=0))
    position = path.position_m - frames.mat_from_quat(quat) @ lever
    step_s = STEP_NS * 1e-9
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(quat[:-1]), quat[1:])) / step_s
    first = (path.start_ns - motion.start_ns) // STEP_NS
    return Trajectory(
        frame,
        grid_ns(path),
        position,
        np.gradient(position, step_s, axis=0),
        quat,
        np.concatenate([turn[:1], 0.5 * (turn[1:] + turn[:-1]), turn[-1:]]),
        sigma_position_m,
        sigma_attitude_rad,
        np.append(motion.known[first : first + len(quat) - 1], False),
    )


_UNITS: Final = {
    "bias": "_deg_s", "scale": "", "turn": "_deg", "delay": "_s", "accel_bias": "_m_s2", "lever": "_m",
}  # fmt: skip


@dataclass(slots=True)
class CausalRun:
    """The odometry alone: what was known at each moment, a tenth of a second late."""

    SIGMA_SOURCE: ClassVar = (
        "the filter's covariance; position and heading as uncertain as the fix and the compass that it began from"
    )

    path: Path
    track: Track
    motion: Motion
    start_sigma_m: Array

    def mount(self, nominal: Mount) -> Mount:
        """The nominal mount: nothing else is known in time."""
        return nominal

    def trajectory(self, given: Given, mount: Mount) -> Trajectory:
        """The path as that of the ins frame."""
        sigma = np.array([self.track.sigma[0], *self.track.sigma])
        grid, knots = np.arange(len(self.path.quat)), np.arange(len(sigma)) * STEPS
        attitude, position = (
            np.stack([np.interp(grid, knots, axis) for axis in part.T], axis=1) for part in (sigma[:, :3], sigma[:, 3:])
        )
        attitude = np.hypot(attitude, ATTITUDE_SIGMA_RAD * np.array([1.0, 1.0, 2.5]))
        return of_ins(self.path, self.motion, given.frame, mount, np.hypot(position, self.start_sigma_m), attitude)

    def warnings(self) -> list[str]:
        """What the self-check found."""
        return lost(self.track)

    def report(self, nominal: Mount) -> dict[str, Any]:
        """What stands in quality.json."""
        del nominal
        return {
            "causal": True,
            "seconds": len(self.track) * H,
            "restarts": self.track.restarts,
            "median_matched": float(np.median(self.track.matched)),
            "median_residual_m": float(np.nanmedian(self.track.residual_m)),
        }


def lost(track: Track) -> list[str]:
    """One sentence where the odometry lost its way."""
    if not track.restarts:
        return []
    return [
        f"the odometry lost its way {track.restarts} times and began anew from the autopilot's pose; the cloud is doubled there"
    ]


def causal_run(given: Given, legs: Sequence[Leg], number: int, start: Trajectory, progress: Progress) -> CausalRun:
    """Odometry over one run of the lidar's clock, nothing of the future used but the gyro's offset."""
    motion, own, other = base_motion(given, legs[0], given.flight.runs[number])
    positions = position_track(given, legs[0])
    mat, lever = given.mount.mat_ins_lidar(), given.mount.lidar_position_m()
    tracker = Tracker(motion, start, mat, lever, gyro_offset(motion, own, other), positions, keep=False)
    track = follow(slices(given, motion.start_ns, progress), tracker)
    return CausalRun(track.causal_path(motion), track, motion, positions.sigma_m[0])


def adjust_run(given: Given, legs: Sequence[Leg], number: int, start: Trajectory, progress: Progress) -> Run:
    """Adjust one run of the lidar's clock."""
    run = given.flight.runs[number]
    leg = max(legs, key=lambda leg: leg.sync.samples)
    mat, lever = given.mount.mat_ins_lidar(), given.mount.lidar_position_m()
    motion, own, other = base_motion(given, leg, run)
    positions = [position_track(given, leg) for leg in legs]
    tracker = Tracker(motion, start, mat, lever, gyro_offset(motion, own, other), positions[0])
    track = follow(slices(given, motion.start_ns, progress), tracker)
    batch = make_batch(given, legs, track, motion, own, other, 0, len(track))
    posterior = batch.run()
    return Run(batch.path, batch, posterior.draws(DRAWS), posterior, track, motion)


def make_batch(
    given: Given, legs: Sequence[Leg], track: Track, motion: Motion, own: ImuTrack | None, other: ImuTrack | None, first: int, last: int
) -> Batch:  # fmt: skip
    """The batch over slices `first` to `last` of a track."""
    mat, lever = given.mount.mat_ins_lidar(), given.mount.lidar_position_m()
    path = track.path(motion, first, last)
    bias = np.array(track.gyro_bias[first:last]).mean(axis=0)
    to_ins = -mat.T @ lever
    units, tracks = [], {}
    for name, unit in (("lidar", own), ("ins", other)):
        if unit is not None:
            offset = bias if unit is own or own is None else np.zeros(3)
            units.append(make_unit(name, unit, path, offset, np.zeros(3) if name == "lidar" else to_ins))
            tracks[name] = unit
    attitudes = [attitude_track(leg) for leg in legs]
    return Batch(
        path, track.gathered(first, last), units, tracks, [position_track(given, leg) for leg in legs],
        [a for a in attitudes if a is not None], mat.T, to_ins,
    )  # fmt: skip


def gyro_offset(motion: Motion, own: ImuTrack | None, other: ImuTrack | None) -> Array:
    """Where to begin with the bias of the gyro that carries the motion: its mean difference from the autopilot's, which has a small one."""
    if own is None or other is None or motion.source != own.name:
        return np.zeros(3)
    rate, known = on_grid(other.time_ns, other.rate_rad_s, motion.start_ns, len(motion))
    own_rate, own_known = on_grid(own.time_ns, own.rate_rad_s, motion.start_ns, len(motion))
    both = known & own_known
    return np.asarray((own_rate - rate)[both].mean(axis=0)) if both.any() else np.zeros(3)


def position_track(given: Given, leg: Leg) -> Positions:
    """The autopilot's positions in the local frame."""
    fixes = given.fixes[list(given.placed).index(leg)]
    place = given.frame.from_geodetic(fixes.latitude_deg, fixes.longitude_deg, fixes.height_m)
    mat, lever = given.mount.mat_ins_lidar(), given.mount.lidar_position_m()
    antenna = np.zeros(3) if given.mount.gps_position_m is None else np.array(given.mount.gps_position_m)
    return Positions(
        leg.utc_from_boot(fixes.time_ns),
        place,
        np.maximum(fixes.sigma_m, LEAST_POSITION_SIGMA_M),
        mat.T @ (antenna - lever),
        POSITION_TAU_S,
        POSITION_WHITE_M,
    )


def attitude_track(leg: Leg) -> Attitudes | None:
    """The autopilot's attitudes."""
    if ins.attitude_source(leg.boot) is None:
        return None
    _, time_ns, quat, _ = ins.attitudes(leg.boot)
    return Attitudes(leg.utc_from_boot(time_ns), quat, ATTITUDE_SIGMA_RAD, ATTITUDE_TAU_S)
