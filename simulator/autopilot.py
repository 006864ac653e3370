"""The autopilot's MAVLink: which message when, from which state, received when.

ArduCopter 3.1.3 serves its streams in a 50 Hz task: a rate asked for becomes floor(50 / rate) + 1 ticks, 25 Hz at most. Stamps are
taken when a message is built; the state in it may be up to a main loop older. Every message's base is that of its definition
(common.xml): milliseconds or microseconds since boot.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from pymavlink.dialects.v20 import ardupilotmega

from flightlog.constants import NS_PER_MS, NS_PER_S, NS_PER_US, STANDARD_GRAVITY_M_S2
from simulator.cameras import Exposure
from simulator.chance import generator
from simulator.clocks import Clock, Clocks
from simulator.config import LinkOptions, Options
from simulator.faults import Outage, Reboot, garbage_before
from simulator.geodesy import Origin, geodetic
from simulator.ins import Belief, Ins

Array = npt.NDArray[np.float64]

_TICK_HZ: Final = 50.0
_GPS_HZ: Final = 5.0
_FIX_LATE_S: Final = 0.12
"""A fix comes in this long after its epoch."""
_FEEDBACK: Final = "camera_feedback"
_FEEDBACK_LATE_S: Final = 0.004
"""From an exposure to the message about it."""
_U32: Final = 1 << 32
_JUST_AFTER_NS: Final = 200
SYSTEM: Final = 1


class Frame(NamedTuple):
    """Bytes of a message, when it was built and when it is received [true s], and line noise ahead of it."""

    built_s: float
    received_s: float
    data: bytes
    noise: bytes


def achieved_hz(asked_hz: float, firmware: str) -> float:
    """Rate at which a stream really comes."""
    if asked_hz <= 0:
        return 0.0
    if firmware == "3.1.3":
        return _TICK_HZ / (_TICK_HZ // asked_hz + 1)
    return asked_hz


@dataclass(frozen=True, slots=True)
class _Moment:
    """One instant at which a message is built; of exposures which."""

    time_s: float
    boot_ns: int
    utc_ns: int
    epoch_ns: int
    fix_boot_ns: int
    row: int
    belief: Belief
    geodetic: tuple[Array, Array, Array]
    event: int = 0

    @property
    def boot_ms(self) -> int:
        return self.boot_ns // NS_PER_MS % _U32


class Autopilot:
    """Builds the MAVLink stream of one simulation, stretch by stretch."""

    def __init__(
        self, ins: Ins, clocks: Clocks, options: Options, origin: Origin, seed: int, noted: Sequence[Exposure] = ()
    ) -> None:
        self._ins, self._clocks, self._origin, self._seed = ins, clocks, origin, seed
        self._noted, self._noted_s = noted, np.array([one.time_s for one in noted])
        self._options: LinkOptions = options.link
        self._reboot, self._outage = Reboot.of(options.faults), Outage.of(options.faults)
        self._last_fix = self._fix_before_outage()
        self._garbage_hz, self._fix_from_s = options.faults.garbage_per_s, options.faults.gnss_from_s
        self._mavlink = ardupilotmega.MAVLink(None, srcSystem=SYSTEM, srcComponent=1)
        self._last_received_s = -np.inf
        self._was_after_reboot = False
        link = options.link
        asked: dict[str, float] = {}
        for names, rate_hz in (
            (("raw_imu", "scaled_pressure"), link.raw_sensors_hz),
            (("attitude",), link.extra1_hz),
            (("global_position_int",), link.position_hz),
            (("gps_raw_int", "sys_status"), link.status_hz),
            (("vfr_hud",), link.extra2_hz),
            (("system_time",), link.extra3_hz),
        ):
            asked |= dict.fromkeys(names, achieved_hz(rate_hz, link.firmware))
        self.rates_hz: dict[str, float] = {"heartbeat": 1.0} | {k: v for k, v in asked.items() if v > 0}
        self._builders: dict[str, Callable[[_Moment], Any]] = {
            name: getattr(self, f"_{name}") for name in (*self.rates_hz, *([_FEEDBACK] if len(noted) else []))
        }

    def between(self, start_s: float, end_s: float, chunk: int) -> Iterator[Frame]:
        """Frames built in [start, end), in order; a stretch must follow on the one before."""
        rng = generator(self._seed, "autopilot", chunk)
        times, names = self._schedule(start_s, end_s)
        if not len(times):
            return
        if not self._options.stamp_jitter_s:
            times = self._on_whole_ms(times)
        jitter_s = rng.uniform(-1, 1, len(times)) * self._options.stamp_jitter_s
        belief = self._ins.belief(times + jitter_s, rng)
        place = geodetic(belief.position_m, self._origin)
        late_s = self._options.latency_s + self._options.latency_jitter_s * rng.exponential(size=len(times))
        for row, (time_s, name) in enumerate(zip(times.tolist(), names, strict=True)):
            if self._reboot.silent(time_s):
                continue
            self._restart(time_s)
            kind, _, number = name.partition(" ")
            moment = replace(self._moment(time_s, row, belief, place), event=int(number or 0))
            data = self._pack(self._builders[kind](moment))
            self._last_received_s = max(self._last_received_s, time_s + late_s[row])
            noise = garbage_before(rng, self._garbage_hz / sum(self.rates_hz.values()))
            yield Frame(time_s, self._last_received_s, data, noise)

    def boot_clock(self, time_s: float) -> Clock:
        """The boot clock in force at a true time: a reboot starts another."""
        return self._reboot.clock(time_s, self._clocks.boot)

    def _fix_before_outage(self) -> "_Moment | None":
        """What the receiver goes on stating while it has no fix: its last one."""
        if self._outage.start_s <= 0:
            return None
        time_s = max(self._outage.start_s - 1.0 / _GPS_HZ, 0.0)
        belief = self._ins.belief(np.array([time_s]), generator(self._seed, "last fix"))
        return self._moment(time_s, 0, belief, geodetic(belief.position_m, self._origin))

    def _schedule(self, start_s: float, end_s: float) -> tuple[Array, list[str]]:
        """Build times in [start, end) in order, and what is built."""
        times, names = [], []
        for i, (name, rate_hz) in enumerate(self.rates_hz.items()):
            phase_s = 0.0007 * i + 0.004
            first = np.ceil((start_s - phase_s) * rate_hz - 1e-9)
            own = (np.arange(first, np.ceil((end_s - phase_s) * rate_hz - 1e-9)) / rate_hz) + phase_s
            times.append(own)
            names += [name] * len(own)
        sent_s = self._noted_s + _FEEDBACK_LATE_S
        mine = np.flatnonzero((sent_s >= start_s) & (sent_s < end_s))
        times.append(sent_s[mine])
        names += [f"{_FEEDBACK} {number}" for number in mine.tolist()]
        joined = np.concatenate(times)
        order = np.argsort(joined, kind="stable")
        return joined[order], [names[i] for i in order]

    def _on_whole_ms(self, times: Array) -> Array:
        """The next times at which the boot clock has just gone to another millisecond: stamps without rounding."""
        clock = self._clocks.boot
        whole_ns = -(-clock.shows_ns(times) // NS_PER_MS) * NS_PER_MS
        return clock.time_s((whole_ns - clock.start_ns + _JUST_AFTER_NS) / NS_PER_S)

    def _restart(self, time_s: float) -> None:
        after = self._reboot.after(time_s)
        if after and not self._was_after_reboot:
            self._mavlink.seq = 0
        self._was_after_reboot = after

    def _moment(self, time_s: float, row: int, belief: Belief, place: tuple[Array, Array, Array]) -> _Moment:
        clock = self.boot_clock(time_s)
        epoch_s = np.floor((time_s - _FIX_LATE_S) * _GPS_HZ) / _GPS_HZ
        return _Moment(
            time_s=time_s,
            boot_ns=int(clock.shows_ns(time_s)),
            utc_ns=int(self._clocks.utc.shows_ns(time_s)),
            epoch_ns=int(self._clocks.utc.shows_ns(epoch_s)),
            fix_boot_ns=int(clock.shows_ns(epoch_s + _FIX_LATE_S)),
            row=row,
            belief=belief,
            geodetic=place,
        )

    def _pack(self, message: Any) -> bytes:
        data = bytes(message.pack(self._mavlink, force_mavlink1=self._options.version == 1))
        self._mavlink.seq = (self._mavlink.seq + 1) % 256
        return data

    # What is in each message ----------------------------------------------------------------------------------------

    def _heartbeat(self, _: _Moment) -> Any:
        return ardupilotmega.MAVLink_heartbeat_message(13, 3, 209, 3, 4, 3)

    def _attitude(self, m: _Moment) -> Any:
        b, i = m.belief, m.row
        yaw = (b.heading_rad[i] + np.pi) % (2 * np.pi) - np.pi
        return ardupilotmega.MAVLink_attitude_message(
            m.boot_ms, b.roll_rad[i], b.pitch_rad[i], yaw, *b.rates_frd_rad_s[i]
        )

    def _raw_imu(self, m: _Moment) -> Any:
        accel_mg = m.belief.force_frd_m_s2[m.row] / STANDARD_GRAVITY_M_S2 * 1000.0
        rates_mrad = m.belief.rates_frd_rad_s[m.row] * 1000.0
        values = np.clip(np.rint(np.concatenate([accel_mg, rates_mrad])), -32768, 32767).astype(int)
        usec = m.boot_ns // NS_PER_US
        if self._options.firmware == "3.1.3":  # its micros() has 32 bits
            usec %= _U32
        field = np.rint(m.belief.field_frd_mgauss[m.row]).astype(int)
        return ardupilotmega.MAVLink_raw_imu_message(usec, *values.tolist(), *field.tolist())

    def _scaled_pressure(self, m: _Moment) -> Any:
        height_m = self._origin.height_msl_m + m.belief.baro_height_m[m.row]
        hpa = 1013.25 * (1 - 2.25577e-5 * height_m) ** 5.25588
        return ardupilotmega.MAVLink_scaled_pressure_message(m.boot_ms, hpa, 0.0, 3150)

    def _place(self, m: _Moment) -> tuple[int, int, int]:
        latitude, longitude, height = (v[m.row] for v in m.geodetic)
        return round(latitude * 1e7), round(longitude * 1e7), round(height * 1e3)

    def _global_position_int(self, m: _Moment) -> Any:
        latitude, longitude, height_mm = self._place(m)
        east, north, up = m.belief.velocity_m_s[m.row] * 100.0
        heading = round(np.degrees(m.belief.heading_rad[m.row]) * 100.0) % 36000
        relative_mm = round(m.belief.position_m[m.row, 2] * 1e3)
        stamp_ms = m.boot_ms
        if m.time_s < self._fix_from_s:
            return ardupilotmega.MAVLink_global_position_int_message(stamp_ms, 0, 0, 0, relative_mm, 0, 0, 0, heading)
        if self._options.position_stamp == "fix" and not self._outage.holds(m.time_s):
            stamp_ms = m.fix_boot_ns // NS_PER_MS % _U32
        return ardupilotmega.MAVLink_global_position_int_message(
            stamp_ms, latitude, longitude, height_mm, relative_mm, round(north), round(east), round(-up), heading
        )

    def _gps_raw_int(self, m: _Moment) -> Any:
        fix, dilution, satellites = 3, 120, 11
        if m.time_s < self._fix_from_s:
            return ardupilotmega.MAVLink_gps_raw_int_message(0, 1, 0, 0, 0, 9999, 65535, 0, 0, 3)
        if self._last_fix is not None and self._outage.holds(m.time_s):
            m, fix, dilution, satellites = self._last_fix, 1, 9999, 3
        latitude, longitude, height_mm = self._place(m)
        east, north, _ = m.belief.velocity_m_s[m.row]
        course = round(np.degrees(np.arctan2(east, north)) * 100.0) % 36000
        since_epoch_ns = m.utc_ns - m.epoch_ns
        return ardupilotmega.MAVLink_gps_raw_int_message(
            (m.boot_ns - since_epoch_ns) // NS_PER_US,
            fix,
            latitude,
            longitude,
            height_mm,
            dilution,
            65535,
            round(np.hypot(east, north) * 100.0),
            course,
            satellites,
        )

    def _sys_status(self, _: _Moment) -> Any:
        return ardupilotmega.MAVLink_sys_status_message(0x3F, 0x3F, 0x3F, 310, 15200, 2400, 74, 0, 0, 0, 0, 0, 0)

    def _vfr_hud(self, m: _Moment) -> Any:
        east, north, up = m.belief.velocity_m_s[m.row]
        speed = float(np.hypot(east, north))
        heading = int(np.degrees(m.belief.heading_rad[m.row])) % 360
        height_m = float(m.geodetic[2][m.row])
        return ardupilotmega.MAVLink_vfr_hud_message(speed, speed, heading, 48, height_m, float(up))

    def _camera_feedback(self, m: _Moment) -> Any:
        one = self._noted[m.event]
        latitude, longitude, height_mm = self._place(m)
        b, i = m.belief, m.row
        angles = np.degrees([b.roll_rad[i], b.pitch_rad[i], b.heading_rad[i] % (2 * np.pi)])
        stamp_us = int(self._clocks.utc.shows_ns(one.time_s)) // NS_PER_US
        height_m = height_mm * 1e-3
        return ardupilotmega.MAVLink_camera_feedback_message(
            stamp_us, SYSTEM, one.camera, one.number, latitude, longitude, height_m, float(b.position_m[i, 2]),
            *angles.tolist(), 0.0, 0,
        )  # fmt: skip

    def _system_time(self, m: _Moment) -> Any:
        utc_ns = m.utc_ns if self._options.system_time == "exact" else m.epoch_ns
        return ardupilotmega.MAVLink_system_time_message(utc_ns // NS_PER_US, m.boot_ms)
