"""A simulation of one job: scene, flight and instruments, rendered in pieces of about 0.1 s that depend on nothing but their number."""

import dataclasses
from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import __version__
from flightlog.config import to_mapping
from flightlog.hdl32e import BLOCKS, FIRING_NS
from flightlog.mount import Mount
from simulator.autopilot import Autopilot
from simulator.cameras import CameraOptions, built, noted
from simulator.chance import generator
from simulator.clocks import Clocks, clocks
from simulator.config import Options
from simulator.faults import Outage, Reboot
from simulator.flight import Flight
from simulator.geodesy import Origin
from simulator.ins import Ins
from simulator.lidar import Lidar, Sweep
from simulator.moving import Traffic
from simulator.photographs import Studio
from simulator.scene import Scene, scene
from simulator.telemetry import Telemetry

Array = npt.NDArray[np.float64]

_FIRINGS_IN_A_CHUNK: Final = 181 * BLOCKS


@dataclass(frozen=True, slots=True)
class Job:
    """What to simulate and where to put it."""

    scene: str
    duration_s: float
    seed: int
    directory: Path
    options: Options
    workers: int = 2
    truth_points: bool = False
    cameras: Mapping[str, CameraOptions] = field(default_factory=dict)


def logged_mount(scenes: Mount, options: Options) -> Mount:
    """The nominal mount, as the log has it: the scene's where the options do not say otherwise, with the antenna of the options."""
    o = options.mount
    lidar = scenes.lidar
    if o.lidar_position_m is not None:
        lidar = dataclasses.replace(lidar, position_m=o.lidar_position_m)
    if o.lidar_deg is not None:
        yaw, pitch, roll = o.lidar_deg
        lidar = dataclasses.replace(lidar, yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)
    return dataclasses.replace(scenes, lidar=lidar, gps_position_m=o.gps_position_m)


def true_mount(nominal: Mount, options: Options, seed: int) -> Mount:
    """The mount as it really is, the nominal one changed by the options and by chance."""
    o = options.mount
    by_chance = generator(seed, "mount").uniform(-1.0, 1.0, (2, 3))
    yaw, pitch, roll = np.add(o.boresight_deg, o.boresight_spread_deg * by_chance[0]).tolist()
    position = np.add(nominal.lidar.position_m, o.lever_m) + o.lever_spread_m * by_chance[1]
    antenna = nominal.gps_position_m
    if any(o.gps_error_m):
        antenna = _triple(np.add((0.0, 0.0, 0.0) if antenna is None else antenna, o.gps_error_m))
    turned = nominal.with_lidar(
        position_m=_triple(position),
        yaw_deg=_within_turn(nominal.lidar.yaw_deg + yaw),
        pitch_deg=_within_turn(nominal.lidar.pitch_deg + pitch),
        roll_deg=_within_turn(nominal.lidar.roll_deg + roll),
    )
    return dataclasses.replace(turned, gps_position_m=antenna)


def _within_turn(angle_deg: float) -> float:
    """An angle brought to -180 to 180 deg; as it is where it lies there."""
    return angle_deg if abs(angle_deg) <= 180.0 else (angle_deg + 180.0) % 360.0 - 180.0


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


class Simulation:
    """Scene, flight and instruments of one job."""

    def __init__(self, job: Job) -> None:
        self.job = job
        options, seed = job.options, job.seed
        self.scene: Scene = scene(job.scene, seed, options.flight.route)
        self.clocks: Clocks = clocks(options.clocks)
        self.origin = Origin()
        self.flight = Flight(self.scene.route, job.duration_s, options.flight, seed)
        self.nominal_mount = logged_mount(self.scene.mount, options)
        self.mount = true_mount(self.nominal_mount, options, seed)
        self.ins = Ins(self.flight, options.ins, seed, self.mount.gps_position_m, options.faults)
        self.traffic = Traffic(self.scene.tracks, options.moving, seed)
        self.lidar = Lidar(
            self.scene.world, self.flight, self.mount, self.clocks.lidar, options.lidar, seed, self.traffic
        )
        self.telemetry = Telemetry(self.flight, self.mount, self.clocks, options, self.origin, seed)
        self.studio = Studio(
            self.scene.world, self.lidar.surfaces, self.flight, tuple(built(*item, seed) for item in job.cameras.items()),
            self.clocks, self.origin, seed,
        )  # fmt: skip
        self.noted = noted(self.studio.cameras, self.studio.exposures, seed)
        self.autopilot = Autopilot(self.ins, self.clocks, options, self.origin, seed, self.noted)

    @property
    def chunk_packets(self) -> int:
        """Data packets in a piece."""
        return _FIRINGS_IN_A_CHUNK // (BLOCKS // 2 if self.job.options.lidar.returns == "dual" else BLOCKS)

    @property
    def chunks(self) -> int:
        """Pieces in the flight; the last reaches no further than its end."""
        return -(-self.lidar.packets_until(self.job.duration_s) // self.chunk_packets)

    def bounds_s(self, chunk: int) -> tuple[float, float]:
        """True time at which a piece starts and ends."""
        edges_s = np.array([chunk, chunk + 1]) * _FIRINGS_IN_A_CHUNK * FIRING_NS * 1e-9
        low, high = self.clocks.lidar.time_s(edges_s)
        return float(low), min(float(high), self.job.duration_s)

    def sweep(self, chunk: int, truth: bool = True) -> Sweep:
        """Render the data packets of a piece, and the truth about them; safe in any thread."""
        first = chunk * self.chunk_packets
        last = min(first + self.chunk_packets, self.lidar.packets_until(self.job.duration_s) - 1)
        return self.lidar.sweep(first, max(last - first, 0), truth)

    def truth(self) -> dict[str, Any]:
        """All that is true and not a pose or a point."""
        job, link = self.job, self.autopilot.rates_hz
        lidar, boot = self.clocks.lidar, self.clocks.boot
        reboot, outage = Reboot.of(job.options.faults), Outage.of(job.options.faults)
        later = reboot.clock(reboot.end_s, boot) if 0 < reboot.start_s < job.duration_s else None
        return {
            "about": "Time t is true seconds since start; a clock shows start_ns + t * 1e9 * (1 + drift_ppm * 1e-6).",
            "software": f"swath {__version__}",
            "scene": job.scene,
            "seed": job.seed,
            "duration_s": job.duration_s,
            "clocks": {
                name: dataclasses.asdict(getattr(self.clocks, name)) for name in ("utc", "host", "lidar", "boot")
            },
            "boot_clock_after_reboot": None if later is None else dataclasses.asdict(later),
            "reboot_s": None if later is None else [reboot.start_s, reboot.end_s],
            "lidar_minus_boot_ns": lidar.start_ns - boot.start_ns,
            "lidar_minus_boot_ppm": lidar.drift_ppm - boot.drift_ppm,
            "ins_gyro_delay_s": job.options.ins.gyro_delay_s,
            "ins_position_delay_s": job.options.ins.position_delay_s,
            "lidar_imu_delay_s": job.options.gyros.delay_s,
            "mount_nominal": to_mapping(self.nominal_mount),
            "mount_true": to_mapping(self.mount),
            "boresight_deg": self._boresight_deg(),
            "lever_m": np.subtract(self.mount.lidar.position_m, self.nominal_mount.lidar.position_m).tolist(),
            "gps_outage_s": [outage.start_s, outage.end_s] if outage.start_s > 0 else None,
            "laser_bias_m": self.lidar.laser_bias_m.tolist(),
            "laser_elevation_error_deg": self.lidar.elevation_error_deg.tolist(),
            "lidar_gyro_matrix": self.telemetry.gyros.matrix.tolist(),
            "lidar_gyro_offset_deg_s": self.telemetry.gyros.bias.tolist(),
            "lidar_gyro_walk_deg_s_every_10_s": self.telemetry.gyro_wander.listed(),
            "lidar_accel_bias_g": self.telemetry.accel_bias_g.tolist(),
            "ins_gyro_walk_deg_s_every_10_s": np.degrees(self.ins.gyro_wander.listed()).tolist(),
            "ins_accel_walk_m_s2_every_10_s": self.ins.accel_wander.listed(),
            "ins_gyro_matrix": self.ins.gyros.matrix.tolist(),
            "ins_gyro_bias_deg_s": np.degrees(self.ins.gyros.bias).tolist(),
            "ins_accel_matrix": self.ins.accelerometers.matrix.tolist(),
            "ins_accel_bias_m_s2": self.ins.accelerometers.bias.tolist(),
            "compass_phase_rad": self.ins.compass_phase_rad.tolist(),
            "mavlink_hz": link,
            "local_origin": dataclasses.asdict(self.origin),
            "surfaces": [*self.scene.world.names, *self.traffic.names],
            "options": to_mapping(job.options),
        } | ({"cameras": self.studio.truth()} if job.cameras else {})

    def _boresight_deg(self) -> list[float]:
        """True minus nominal yaw, pitch and roll of the lidar."""
        true, nominal = self.mount.lidar, self.nominal_mount.lidar
        names = ("yaw_deg", "pitch_deg", "roll_deg")
        return [_within_turn(getattr(true, name) - getattr(nominal, name)) for name in names]


def in_order(simulation: Simulation, workers: int) -> Iterator[Sweep]:
    """Sweeps of all pieces in order, a few rendered ahead by other threads."""
    with ThreadPoolExecutor(workers) as pool:
        ahead: deque[Future[Sweep]] = deque()
        for chunk in range(simulation.chunks):
            ahead.append(pool.submit(simulation.sweep, chunk, simulation.job.truth_points))
            if len(ahead) > workers + 1:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
