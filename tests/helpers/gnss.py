"""A small world of GPS, and Galileo beside it: broadcast orbits, two receivers, and what they would measure, as RINEX and as u-blox files.

Orbits and clocks by IS-GPS-200 (tables 20-III and 20-IV), so that a program that reads the navigation file finds the very satellites
that were measured. Pseudorange and carrier phase on L1 with receiver clocks, hydrostatic troposphere, white noise and unknown integers; no
ionosphere: over a short baseline it drops out of double differences.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Path3 = Callable[[Array], Array]
"""ECEF positions [m], shape (n, 3), at GPS seconds of week, shape (n,)."""

C_M_S = 299_792_458.0
L1_HZ = 1_575_420_000.0
LAMBDA_M = C_M_S / L1_HZ
MU = {"G": 3.986005e14, "E": 3.986004418e14}
EARTH_RATE = 7.2921151467e-5
RELATIVITY = -4.442807633e-10
A_M, E2 = 6378137.0, 6.69437999014e-3


def ecef(latitude_deg: Array | float, longitude_deg: Array | float, height_m: Array | float) -> Array:
    """WGS 84 by the textbook."""
    lat, lon = np.deg2rad(latitude_deg), np.deg2rad(longitude_deg)
    n = A_M / np.sqrt(1 - E2 * np.sin(lat) ** 2)
    return np.stack(
        [
            (n + height_m) * np.cos(lat) * np.cos(lon),
            (n + height_m) * np.cos(lat) * np.sin(lon),
            (n * (1 - E2) + height_m) * np.sin(lat),
        ],
        axis=-1,
    )


def mat_enu_ecef(latitude_deg: float, longitude_deg: float) -> Array:
    """East, north and up as rows, shape (3, 3)."""
    lat, lon = np.deg2rad([latitude_deg, longitude_deg])
    return np.array(
        [
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )


@dataclass(frozen=True)
class Orbits:
    """Broadcast parameters, shape (satellites,) each; values are what 12 decimals of RINEX hold."""

    week: int
    toe_s: float
    prn: npt.NDArray[np.int64]
    """Galileo's are those over 100."""
    root_a: Array
    eccentricity: Array
    m0: Array
    delta_n: Array
    inclination: Array
    idot: Array
    omega0: Array
    omega_dot: Array
    omega: Array
    cuc: Array
    cus: Array
    crc: Array
    crs: Array
    cic: Array
    cis: Array
    af0: Array
    af1: Array

    def at(self, tow_s: Array) -> tuple[Array, Array]:
        """ECEF positions [m], shape (n, 3), and clock errors [s] at true GPS times, shape (n, satellites) -> (n, satellites, 3)."""
        t = tow_s - self.toe_s
        a = self.root_a**2
        mu = np.where(self.prn > 100, MU["E"], MU["G"])
        m = self.m0 + (np.sqrt(mu / a**3) + self.delta_n) * t
        e = m.copy()
        for _ in range(20):
            e = m + self.eccentricity * np.sin(e)
        nu = np.arctan2(np.sqrt(1 - self.eccentricity**2) * np.sin(e), np.cos(e) - self.eccentricity)
        phi = nu + self.omega
        c2, s2 = np.cos(2 * phi), np.sin(2 * phi)
        u = phi + self.cus * s2 + self.cuc * c2
        r = a * (1 - self.eccentricity * np.cos(e)) + self.crs * s2 + self.crc * c2
        i = self.inclination + self.idot * t + self.cis * s2 + self.cic * c2
        node = self.omega0 + (self.omega_dot - EARTH_RATE) * t - EARTH_RATE * self.toe_s
        x, y = r * np.cos(u), r * np.sin(u)
        place = np.stack(
            [
                x * np.cos(node) - y * np.cos(i) * np.sin(node),
                x * np.sin(node) + y * np.cos(i) * np.cos(node),
                y * np.sin(i),
            ],
            axis=-1,
        )
        clock = self.af0 + self.af1 * t + RELATIVITY * self.eccentricity * self.root_a * np.sin(e)
        return place, clock


def constellation(week: int, toe_s: float, seed: int = 1, *, galileo: bool = False) -> Orbits:
    """30 satellites of GPS in six planes; with Galileo, 24 more in three."""
    rng = np.random.default_rng(seed)
    n = 54 if galileo else 30
    plane, slot = np.divmod(np.arange(30), 5)
    phase, node, prn = slot / 5 + plane / 30, plane * 60.0, np.arange(1, 31)
    if galileo:
        plane, slot = np.divmod(np.arange(24), 8)
        phase, node = np.append(phase, slot / 8 + plane / 24), np.append(node, plane * 120.0 + 20.0)
        prn = np.append(prn, np.arange(101, 125))
    omega = rng.uniform(-3, 3, n)

    def kept(values: Array) -> Array:
        return np.array([float(f"{value:.12E}") for value in np.broadcast_to(values, n)])

    return Orbits(
        week=week,
        toe_s=toe_s,
        prn=prn,
        root_a=kept(np.where(prn > 100, 5440.6, 5153.65) + rng.normal(0, 0.05, n)),
        eccentricity=kept(rng.uniform(0.002, 0.015, n)),
        m0=kept((2 * np.pi * phase + rng.normal(0, 0.1, n) - omega) % (2 * np.pi)),
        delta_n=kept(rng.normal(4.5e-9, 2e-10, n)),
        inclination=kept(np.deg2rad(55.0 + rng.normal(0, 0.5, n))),
        idot=kept(rng.normal(0, 2e-10, n)),
        omega0=kept((np.deg2rad(node) + 0.3) % (2 * np.pi) - np.pi),
        omega_dot=kept(rng.normal(-8e-9, 2e-10, n)),
        omega=kept(omega),
        cuc=kept(rng.normal(0, 2e-6, n)),
        cus=kept(rng.normal(5e-6, 2e-6, n)),
        crc=kept(rng.normal(250, 50, n)),
        crs=kept(rng.normal(0, 50, n)),
        cic=kept(rng.normal(0, 1e-7, n)),
        cis=kept(rng.normal(0, 1e-7, n)),
        af0=kept(rng.normal(0, 2e-4, n)),
        af1=kept(rng.normal(0, 3e-12, n)),
    )


@dataclass(frozen=True)
class Receiver:
    """What one receiver measures.

    `tow_s` are its own epochs (n,); code_m, phase_cycles, doppler_hz (n, satellites), not a number where unseen; clock_s (n,) what its
    clock is ahead.
    """

    week: int
    tow_s: Array
    prn: npt.NDArray[np.int64]
    code_m: Array
    phase_cycles: Array
    doppler_hz: Array
    clock_s: Array
    place_m: Array
    """True antenna positions, ECEF, at `true_tow_s`."""
    slipped: npt.NDArray[np.bool_]
    """Where the receiver noticed that it lost count of cycles, shape (n, satellites)."""

    @property
    def true_tow_s(self) -> Array:
        return self.tow_s - self.clock_s

    def part(self, chosen: slice) -> "Receiver":
        names = ("tow_s", "code_m", "phase_cycles", "doppler_hz", "clock_s", "place_m", "slipped")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})


def _elevation_sine(place: Array, line: Array) -> Array:
    """Sine of the elevation of lines of sight (n, s, 3) from places (n, 3), above the ellipsoid's tangent plane."""
    up = place / np.array([A_M, A_M, A_M * np.sqrt(1 - E2)]) ** 2
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    return np.asarray(np.einsum("ni,nsi->ns", up, line))


def _height_m(place: Array) -> Array:
    p = np.hypot(place[:, 0], place[:, 1])
    lat = np.arctan2(place[:, 2], p * (1 - E2))
    for _ in range(5):
        n = A_M / np.sqrt(1 - E2 * np.sin(lat) ** 2)
        lat = np.arctan2(place[:, 2] + E2 * n * np.sin(lat), p)
    return np.asarray(p / np.cos(lat) - A_M / np.sqrt(1 - E2 * np.sin(lat) ** 2))


def _troposphere_m(place: Array, sine: Array) -> Array:
    """Hydrostatic delay: Saastamoinen's zenith delay in the standard atmosphere, mapped as Black and Eisner do."""
    pressure = 1013.25 * (1 - 2.2557e-5 * _height_m(place)) ** 5.2568
    return np.asarray(0.0022768 * pressure[:, None] * 1.001 / np.sqrt(0.002001 + np.maximum(sine, 0.05) ** 2))


def _gauss_markov(rng: np.random.Generator, time_s: Array, tau_s: float, count: int) -> Array:
    """Unit first-order Gauss-Markov processes, shape (n, count)."""
    found = rng.normal(size=(len(time_s), count))
    for k in range(1, len(time_s)):
        kept = np.exp(-(time_s[k] - time_s[k - 1]) / tau_s)
        found[k] = kept * found[k - 1] + np.sqrt(1 - kept**2) * found[k]
    return found


def measure(
    orbits: Orbits,
    path: Path3,
    tow_s: Array,
    *,
    seed: int,
    clock: tuple[float, float] = (0.0, 0.0),
    code_sigma_m: float = 0.5,
    phase_sigma_m: float = 0.003,
    doppler_sigma_m_s: float = 0.03,
    mask_deg: float = 8.0,
    multipath: tuple[float, float, float] = (0.0, 0.0, 20.0),
    slips_each_s: float = 0.0,
    slips_noticed: bool = True,
) -> Receiver:
    """Observations at a receiver's own epochs; its clock is off by clock[0] + clock[1] * (time since the first epoch).

    White noise grows with low elevation: sigma^2 = s^2 (1 + 1 / sin^2), as RTKLIB's model has it. `multipath` is code [m], phase [m] and
    correlation time [s] of errors that hang together, which RTKLIB knows nothing of; `slips_each_s` is how often a satellite slips by
    whole cycles, and the receiver notices it or not.
    """
    rng = np.random.default_rng(seed)

    def ranges(reading_s: Array) -> tuple[Array, Array, Array, Array]:
        """Noiseless pseudoranges, sine of elevation, places and clock errors when the receiver's clock reads so."""
        error_s = clock[0] + clock[1] * (reading_s - tow_s[0])
        t = reading_s - error_s
        place = path(t)
        sent = np.repeat(t[:, None] - 0.075, len(orbits.prn), axis=1)
        for _ in range(6):
            satellite, clock_s = orbits.at(sent)
            turn = EARTH_RATE * (t[:, None] - sent)
            x, y = satellite[..., 0], satellite[..., 1]
            turned = [x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn), satellite[..., 2]]
            line = np.stack(turned, axis=-1) - place[:, None]
            distance = np.linalg.norm(line, axis=-1)
            sine = _elevation_sine(place, line / distance[..., None])
            delayed = distance + _troposphere_m(place, sine)
            sent = t[:, None] - delayed / C_M_S
        return delayed + C_M_S * (error_s[:, None] - clock_s), sine, place, error_s

    full, sine, place, error_s = ranges(tow_s)
    rate = (ranges(tow_s + 0.01)[0] - ranges(tow_s - 0.01)[0]) / 0.02
    scale = np.sqrt(1 + 1 / np.maximum(sine, 0.1) ** 2)
    code = full + code_sigma_m * scale * rng.normal(size=full.shape)
    cycles = rng.integers(-50_000, 50_000, len(orbits.prn))
    phase = (full + phase_sigma_m * scale * rng.normal(size=full.shape)) / LAMBDA_M + cycles
    code += multipath[0] * scale * _gauss_markov(rng, tow_s, multipath[2], len(orbits.prn))
    phase += multipath[1] / LAMBDA_M * scale * _gauss_markov(rng, tow_s, multipath[2], len(orbits.prn))
    slipped = rng.random(full.shape) < slips_each_s * float(np.median(np.diff(tow_s)))
    phase += np.cumsum(np.where(slipped, rng.integers(1, 20, full.shape), 0), axis=0)
    rate += doppler_sigma_m_s * scale * rng.normal(size=full.shape)
    hidden = sine < np.sin(np.deg2rad(mask_deg))
    values = [np.where(hidden, np.nan, v) for v in (code, phase, -rate / LAMBDA_M)]
    return Receiver(orbits.week, tow_s, orbits.prn, *values, error_s, place, slipped & slips_noticed)


def _epoch(week: int, tow_s: float) -> tuple[datetime, str]:
    """Calendar of a GPS time, and its seconds with seven decimals."""
    tenths = round(tow_s * 1e7)
    whole, rest = divmod(tenths, 10_000_000)
    moment = datetime(1980, 1, 6, tzinfo=UTC) + timedelta(weeks=week, seconds=whole)
    return moment, f"{moment.second:3d}.{rest:07d}"


def _line(content: str, label: str) -> str:
    return f"{content:<60}{label}\n"


def write_observations(
    path: Path, receiver: Receiver, *, version: str = "3.04", approximate_m: Array | None = None, height_m: float = 0.0
) -> None:
    """RINEX 3.04 or 2.11 with C1, L1 and D1 of GPS; `approximate_m` goes into the header, `height_m` is the antenna's above the marker."""
    x, y, z = np.zeros(3) if approximate_m is None else approximate_m
    first, seconds = _epoch(receiver.week, float(receiver.tow_s[0]))
    mixed = "M: Mixed" if receiver.prn.max() > 100 else "G (GPS)"
    head = [
        _line(f"{float(version):9.2f}           OBSERVATION DATA    {mixed}", "RINEX VERSION / TYPE"),
        _line("made for a test", "COMMENT"),
        _line(f"{x:14.4f}{y:14.4f}{z:14.4f}", "APPROX POSITION XYZ"),
        _line(f"{height_m:14.4f}{0.0:14.4f}{0.0:14.4f}", "ANTENNA: DELTA H/E/N"),
    ]
    if version.startswith("3"):
        head += [
            _line(f"{letter}    3 C1C L1C D1C", "SYS / # / OBS TYPES") for letter in ("GE" if mixed[0] == "M" else "G")
        ]
    else:
        head.append(_line("     3    C1    L1    D1", "# / TYPES OF OBSERV"))
    stamp = f"{first.year:6d}{first.month:6d}{first.day:6d}{first.hour:6d}{first.minute:6d}  {seconds}     GPS"
    head += [_line(stamp, "TIME OF FIRST OBS"), _line("", "END OF HEADER")]
    with path.open("w", encoding="ascii") as file:
        file.writelines(head)
        for k in range(len(receiver.tow_s)):
            file.writelines(_epoch_lines(receiver, k, version))


def _epoch_lines(receiver: Receiver, k: int, version: str) -> list[str]:
    seen = np.flatnonzero(np.isfinite(receiver.code_m[k]))
    moment, seconds = _epoch(receiver.week, float(receiver.tow_s[k]))
    lost = ["1" if receiver.slipped[k, s] else " " for s in seen]
    values = [
        f"{receiver.code_m[k, s]:14.3f}  {receiver.phase_cycles[k, s]:14.3f}{mark} {receiver.doppler_hz[k, s]:14.3f}  \n"
        for s, mark in zip(seen, lost, strict=True)
    ]
    names = [_name(receiver.prn[s]) for s in seen]
    if version.startswith("3"):
        head = f"> {moment:%Y %m %d %H %M}{seconds}  0{len(seen):3d}\n"
        return [head, *(name + value for name, value in zip(names, values, strict=True))]
    rows = ["".join(names[i : i + 12]) for i in range(0, len(names), 12)]
    year = f" {moment:%y} {moment.month:2d} {moment.day:2d} {moment.hour:2d} {moment.minute:2d}"
    return [f"{year}{seconds}  0{len(seen):3d}{rows[0]}\n", *(" " * 32 + row + "\n" for row in rows[1:]), *values]


def write_navigation(path: Path, orbits: Orbits, *, version: str = "3.04") -> None:
    """RINEX 3.04 or 2.11 navigation file of GPS: one set for each satellite."""
    moment, _ = _epoch(orbits.week, orbits.toe_s)
    with path.open("w", encoding="ascii") as file:
        code = "N: GNSS NAV DATA    M: Mixed" if version.startswith("3") else "N: GPS NAV DATA"
        file.write(_line(f"{float(version):9.2f}           {code}", "RINEX VERSION / TYPE"))
        file.write(_line("", "END OF HEADER"))
        for s in range(len(orbits.prn)):
            if version.startswith("3"):
                head, indent = f"{_name(orbits.prn[s])} {moment:%Y %m %d %H %M %S}", "    "
            else:
                clock = f"{moment.month:2d} {moment.day:2d} {moment.hour:2d} {moment.minute:2d}"
                head, indent = f"{orbits.prn[s]:2d} {moment:%y} {clock} {moment.second:4.1f}", "   "
            rows = [
                (0.0, orbits.crs[s], orbits.delta_n[s], orbits.m0[s]),
                (orbits.cuc[s], orbits.eccentricity[s], orbits.cus[s], orbits.root_a[s]),
                (orbits.toe_s, orbits.cic[s], orbits.omega0[s], orbits.cis[s]),
                (orbits.inclination[s], orbits.crc[s], orbits.omega[s], orbits.omega_dot[s]),
                (orbits.idot[s], 517.0 if orbits.prn[s] > 100 else 1.0, float(orbits.week), 0.0),  # 517: I/NAV
                (2.0, 0.0, 0.0, 0.0),
                (orbits.toe_s - 6.0, 4.0),
            ]
            file.write(head + "".join(_exponent(v) for v in (orbits.af0[s], orbits.af1[s], 0.0)) + "\n")
            file.writelines(indent + "".join(_exponent(v) for v in row) + "\n" for row in rows)


def _name(prn: int) -> str:
    return f"E{prn - 100:02d}" if prn > 100 else f"G{prn:02d}"


def _exponent(value: float) -> str:
    return f"{value:19.12E}".replace("E", "D")


def write_ubx(path: Path, receiver: Receiver) -> None:
    """u-blox UBX-RXM-RAWX messages (version 1), as an M8T or F9P sends them."""
    with path.open("wb") as file:
        for k in range(len(receiver.tow_s)):
            seen = np.flatnonzero(np.isfinite(receiver.code_m[k]))
            body = struct.pack("<dHbBBB2x", receiver.tow_s[k], receiver.week, 18, len(seen), 1, 1)
            for s in seen:
                body += struct.pack(
                    "<ddfBBBBHBBBBBx",
                    receiver.code_m[k, s], receiver.phase_cycles[k, s], receiver.doppler_hz[k, s],
                    2 if receiver.prn[s] > 100 else 0, int(receiver.prn[s]) % 100, 0, 0,
                    0 if receiver.slipped[k, s] else 64000, 45, 3, 1, 4, 7,
                )  # fmt: skip
            file.write(ubx_frame(0x02, 0x15, body))


def ubx_frame(kind: int, number: int, body: bytes) -> bytes:
    """A UBX frame with its Fletcher checksum."""
    framed = struct.pack("<BBH", kind, number, len(body)) + body
    a = b = 0
    for byte in framed:
        a = (a + byte) & 255
        b = (b + a) & 255
    return b"\xb5\x62" + framed + bytes([a, b])
