"""A flight of a line scanner's kit with known truth: over level ground with boxes, IMU with noise, GPS once a second."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from groundproc.geodesy import LocalFrame

Array = npt.NDArray[np.float64]

START_NS = 1_779_272_223_000_000_000
FRAME = LocalFrame(58.394, 15.574, 80.0)
LINE_HZ = 18.0
BOXES = ((-12.0, 5.0, 8.0, 14.0, 3.0), (6.0, 14.0, 25.0, 33.0, 4.0), (-10.0, -2.0, -20.0, -12.0, 2.5))
"""West, east, south, north, height [m]."""
TILT = Rotation.from_euler("X", -90.0, degrees=True)
"""The mount: the scanner looks straight down, its plane across the flight."""


@dataclass(frozen=True)
class Kit:
    """Files of a flight, and what is true of it.

    Attributes
    ----------
    scans, imu, positions, mount : Path
    time_ns : ndarray of int64, shape (n,)
        Of each line.
    position_m, quat_xyzw : ndarray, shape (n, 3) and (n, 4)
        Of the ins frame at each line, in FRAME.
    hits_m : ndarray, shape (k, 3)
        True echoes, line by line, those without a return left out.
    """

    scans: Path
    imu: Path
    positions: Path
    mount: Path
    time_ns: npt.NDArray[np.int64]
    position_m: Array
    quat_xyzw: Array
    hits_m: Array


def place(t: Array) -> Array:
    """A figure of eight at 15 m, 3 m/s, from a stand of two seconds on; east, north, up."""
    s = 0.12 * np.maximum(t - 2.0, 0.0) ** 2 / (np.maximum(t - 2.0, 0.0) + 1.0)
    return np.stack([25.0 * np.sin(s), 20.0 * np.sin(2.0 * s), 15.0 + 1.0 * np.sin(1.7 * s)], axis=1)


def attitude(t: Array) -> Rotation:
    """Swinging a little, and turning with the path, though not with its nose along it."""
    s = 0.12 * np.maximum(t - 2.0, 0.0)
    heading = 0.5 + 0.8 * np.sin(1.3 * s) + 0.3 * s
    pitch, roll = 0.06 * np.sin(0.9 * t), 0.08 * np.sin(0.7 * t + 1.0)
    return Rotation.from_euler("ZXY", np.stack([-heading, pitch, roll], axis=1))


def cast(origins: Array, rays: Array) -> Array:
    """Distance along rays, shape (n,), to ground and boxes."""
    with np.errstate(divide="ignore", invalid="ignore"):
        best = np.where(rays[:, 2] < -0.05, -origins[:, 2] / rays[:, 2], np.inf)
        for west, east, south, north, height in BOXES:
            low, high = np.array([west, south, 0.0]), np.array([east, north, height])
            a, b = (low - origins) / rays, (high - origins) / rays
            near, far = np.nanmax(np.minimum(a, b), axis=1), np.nanmin(np.maximum(a, b), axis=1)
            best = np.where((near <= far) & (near > 0.0), np.minimum(best, near), best)
    return best


def fly(folder: Path, seconds: float = 60.0, seed: int = 1, sigma_range_m: float = 0.01) -> Kit:
    """Write the kit's files: 18 lines a second at 0.25 deg over 120 deg, 200 Hz, 1 Hz."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    line_s = np.arange(1.0, seconds - 1.0, 1.0 / LINE_HZ)
    time_ns = START_NS + np.rint(line_s * 1e9).astype(np.int64)
    line_s = (time_ns - START_NS) * 1e-9
    angle_deg = np.arange(-60.0, 60.001, 0.25)
    turned = np.deg2rad(angle_deg)
    beams = TILT.apply(np.stack([np.sin(turned), np.cos(turned), 0.0 * turned], axis=1))
    position, turn = place(line_s), attitude(line_s)
    many = len(angle_deg)
    rays = Rotation.from_quat(np.repeat(turn.as_quat(), many, axis=0)).apply(np.tile(beams, (len(line_s), 1)))
    origins = np.repeat(position, many, axis=0)
    reach = cast(origins, rays)
    seen = reach < 60.0
    ranges = np.where(seen, reach + rng.normal(0.0, sigma_range_m, len(reach)), 0.0).reshape(len(line_s), many)
    np.savez(
        folder / "scans.npz", time_ns=time_ns, angle_deg=angle_deg, range_m=ranges,
        intensity=np.where(ranges > 0.0, 80.0, 0.0),
    )  # fmt: skip
    _write_imu(folder / "imu.csv", seconds, rng)
    _write_positions(folder / "positions.pos", seconds, rng)
    (folder / "mount.yaml").write_text("lidar:\n  position_m: [0.0, 0.0, 0.0]\n  pitch_deg: -90.0\n")
    hits = (origins + reach[:, None] * rays)[seen]
    return Kit(
        folder / "scans.npz", folder / "imu.csv", folder / "positions.pos", folder / "mount.yaml", time_ns, position,
        turn.as_quat(), hits,
    )  # fmt: skip


def _write_imu(path: Path, seconds: float, rng: np.random.Generator) -> None:
    """Rates with 0.01 deg/s/sqrt(Hz) and a bias of 0.1 deg/s; forces with 1e-3 m/s^2/sqrt(Hz) and 0.02 m/s^2."""
    t = np.arange(0.0, seconds, 0.005)
    half = 0.0025
    rate = (attitude(t - half).inv() * attitude(t + half)).as_rotvec() / (2.0 * half)
    push = (place(t + 0.02) - 2.0 * place(t) + place(t - 0.02)) / 0.02**2
    force = attitude(t).inv().apply(push + np.array([0.0, 0.0, 9.818]))
    rate += np.deg2rad(rng.normal(0.0, 0.1, (len(t), 3)) + np.array([0.1, -0.1, 0.05]))
    force += rng.normal(0.0, 0.014, (len(t), 3)) + np.array([0.02, -0.02, 0.01])
    time_ns = START_NS + np.rint(t * 1e9).astype(np.int64)
    head = "time_ns,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2\n"
    rows = (
        f"{stamp}," + ",".join(f"{value:.7f}" for value in values)
        for stamp, values in zip(time_ns.tolist(), np.hstack([rate, force]).tolist(), strict=True)
    )
    path.write_text(head + "\n".join(rows) + "\n")


def _write_positions(path: Path, seconds: float, rng: np.random.Generator) -> None:
    """An RTKLIB solution once a second, good to 0.1 m in plan and 0.2 m in height."""
    t = np.arange(0.0, seconds, 1.0)
    enu = place(t) + rng.normal(0.0, 1.0, (len(t), 3)) * [0.1, 0.1, 0.2]
    latitude, longitude, height = FRAME.to_geodetic(enu)
    lines = ["% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)"]
    lines.append(
        "%  UTC  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio"
    )
    for when, lat, lon, up in zip(t, latitude, longitude, height, strict=True):
        stamp = np.datetime64(START_NS + round(when * 1e9), "ns").astype("datetime64[ms]").item()
        lines.append(
            f"{stamp:%Y/%m/%d %H:%M:%S.%f}"[:-3]
            + f" {lat:.9f} {lon:.9f} {up:.4f} 4 9 0.1000 0.1000 0.2000 0.0000 0.0000 0.0000 0.00 0.0"
        )
    path.write_text("\n".join(lines) + "\n")
