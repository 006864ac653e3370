"""The HDL-32E: its firings and rotor, and the data packets that come out, bit for bit.

Sources: manual 63-9113 Rev A and Rev E; [measured] is what recordings of real units show.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_US
from flightlog.hdl32e import (
    BLOCK_FLAG,
    BLOCKS,
    DATA_DTYPE,
    ELEVATION_DEG,
    FIRING_NS,
    LASER_NS,
    LASERS,
    PRODUCT_ID,
    RANGE_LSB_M,
    STAMP_WRAP_US,
    ReturnMode,
    packet_ns,
)
from flightlog.mount import Mount
from simulator.chance import generator
from simulator.clocks import Clock
from simulator.config import LidarOptions
from simulator.echoes import LAST, MIXED, RANGE, RAYS, SECOND, STRENGTH, STRONGEST, TRIANGLE, aim, form
from simulator.flight import Flight
from simulator.materials import FALLOFF, REFLECTANCE, TRANSMISSION
from simulator.moving import Traffic
from simulator.parts import World
from simulator.rays import Surfaces

Array = npt.NDArray[np.float64]

MODES: Final = {"strongest": ReturnMode.STRONGEST, "last": ReturnMode.LAST, "dual": ReturnMode.DUAL}
_DARK_PANEL: Final = 0.046
_AIRFRAME_STRENGTH: Final = 0.12

TRUTH_DTYPE: Final = np.dtype(
    [
        ("lidar_ns", "<i8"),
        ("x", "<f8"),
        ("y", "<f8"),
        ("z", "<f8"),
        ("range_m", "<f4"),
        ("normal", "<f4", (3,)),
        ("surface", "<i4"),
        ("triangle", "<i4"),
        ("laser", "u1"),
        ("number", "u1"),
        ("mixed", "?"),
    ]
)
"""A true echo: the shot's time on the lidar's clock (unwrapped), the point in the local frame and its range before any noise, the
surface it lies on, the triangle (-1 on what moves), the laser, 0 for the strongest or only return and 1 for the other one of a pair,
mixed or not."""


_Moved = tuple[Array, npt.NDArray[np.int32]]
"""Planes of moving faces that rays met, and the box of each."""


@dataclass(frozen=True, slots=True)
class Sweep:
    """Some packets on end.

    Attributes
    ----------
    packets : ndarray of DATA_DTYPE, shape (n,)
    sent_s : ndarray, shape (n,)
        True time at which each leaves the sensor, after its last shot.
    truth : ndarray of TRUTH_DTYPE
        Of all returns that are not the airframe's, in order of firing.
    """

    packets: npt.NDArray[np.void]
    sent_s: Array
    truth: npt.NDArray[np.void]


def airframe_range(azimuth_deg: Array, elevation_deg: Array) -> Array:
    """Distance to the airframe [m], 0 where the view is free: two landing legs and the body, all beyond +-105 deg from ahead.

    Arguments broadcast: azimuth 0 to 360, elevation in the sensor frame.
    """
    off = np.abs((azimuth_deg + 180.0) % 360.0 - 180.0)
    leg = np.abs(off - 122.0) < 3.5
    body = (off > 108.0) & (elevation_deg > 2.0)
    battery = (off > 158.0) & (elevation_deg > -12.0)
    distance = np.where(leg, 0.34, 0.0)
    distance = np.where(body, 0.22 + 0.0025 * (180.0 - off), distance)
    return np.asarray(np.where(battery, 0.42 + 0.001 * (180.0 - off), distance))


def intensity(strength: Array) -> npt.NDArray[np.uint8]:
    """The 8-bit reflectivity: 0 to 100 percent of a diffuse surface, 101 to 255 for what shines back (FOI-R--4045--SE)."""
    diffuse = 100.0 * np.minimum(strength, 1.0)
    retro = 155.0 * np.log10(np.maximum(strength, 1.0)) / 2.5
    return np.clip(np.rint(diffuse + retro), 0, 255).astype(np.uint8)


class Lidar:
    """An HDL-32E in a world on a flight.

    Parameters
    ----------
    world, flight, mount, clock
        `mount` is the true one; `clock` the lidar's own.
    options : LidarOptions
    seed : int
    traffic : Traffic, optional
        What moves in the world.
    """

    def __init__(
        self,
        world: World,
        flight: Flight,
        mount: Mount,
        clock: Clock,
        options: LidarOptions,
        seed: int,
        traffic: Traffic | None = None,
    ) -> None:
        self._traffic = traffic if traffic is not None and len(traffic) else None
        self._world, self._flight, self._options, self._seed, self._clock = world, flight, options, seed, clock
        self.surfaces = Surfaces(world)
        self._lever_m, self._mat_ins_lidar = mount.lidar_position_m(), mount.mat_ins_lidar()
        self._tables = np.stack([REFLECTANCE, FALLOFF, TRANSMISSION])
        self._mode = MODES[options.returns]
        self._firings = BLOCKS // 2 if self._mode == ReturnMode.DUAL else BLOCKS
        self._threshold = _DARK_PANEL / options.blind_beyond_m**2
        rng = generator(seed, "lidar")
        self._bias_m = options.laser_bias_m * rng.standard_normal(LASERS)
        self._azimuth_start_deg = float(rng.uniform(0, 360))
        lean = generator(seed, "lidar elevations").standard_normal(LASERS)
        self._elevation_error_deg = options.elevation_error_deg * lean

    @property
    def laser_bias_m(self) -> Array:
        """True range error of each laser [m], shape (32,)."""
        return self._bias_m

    @property
    def elevation_error_deg(self) -> Array:
        """True elevation of each laser minus that of the manual [deg], shape (32,)."""
        return self._elevation_error_deg

    def packets_until(self, time_s: float) -> int:
        """How many packets start before a true time."""
        elapsed_ns = float(self._clock.shows_ns(time_s) - self._clock.start_ns)
        return int(np.ceil(elapsed_ns / packet_ns(self._mode)))

    def sweep(self, first_packet: int, count: int, truth: bool = True) -> Sweep:
        """Render packets `first_packet` to `first_packet + count`, a piece that depends on nothing but these numbers.

        `truth`: say what is true as well, which costs a tenth of the whole.
        """
        firing = first_packet * self._firings + np.arange(count * self._firings + 1)
        elapsed_ns = firing * FIRING_NS
        time_s = self._clock.time_s(elapsed_ns.astype(np.float64) * 1e-9)
        turn_deg = (self._azimuth_start_deg + 6.0 * self._options.rpm * time_s) % 360.0
        step_deg = 6.0 * self._options.rpm * FIRING_NS * 1e-9
        rng = generator(self._seed, "sweep", first_packet)
        airframe_m = self._airframe(turn_deg[:-1], step_deg)
        open_shots = airframe_m == 0.0
        if self._options.dark:
            open_shots[:] = False
        origins, directions, echoes, moved = self._cast(time_s, turn_deg, open_shots, rng, int(firing[0]) * LASERS)
        ranges, strengths = self._returns(echoes, open_shots, airframe_m, rng)
        packets = self._pack(first_packet, count, turn_deg[:-1], ranges, strengths, rng)
        sent_s = time_s[self._firings :: self._firings]
        if not truth:
            return Sweep(packets, sent_s, np.zeros(0, TRUTH_DTYPE))
        true = self._truth(echoes, open_shots, origins, directions, self._clock.start_ns + elapsed_ns, moved)
        return Sweep(packets, sent_s, true)

    def _cast(
        self,
        time_s: Array,
        turn_deg: Array,
        open_shots: npt.NDArray[np.bool_],
        rng: np.random.Generator,
        first_shot: int,
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], Array, _Moved]:
        """Origin and direction of the middle of each open shot's beam, their echoes (shots, 3, 4), and what of them moves."""
        moved: _Moved = np.zeros((0, 4)), np.zeros(0, np.int32)
        if not open_shots.any():
            none = np.zeros((0, 3), np.float32)
            return none, none, np.zeros((0, 3, 4)), moved
        poses = self._flight.poses(time_s)
        mat = poses.mat_local_ins()
        rays = RAYS if self._options.footprint_mrad > 0 else 1
        origins, directions = aim(
            poses.position_m + mat @ self._lever_m,
            mat @ self._mat_ins_lidar,
            np.unwrap(np.radians(turn_deg)),
            np.radians(ELEVATION_DEG + self._elevation_error_deg),
            LASER_NS / FIRING_NS,
            self._options.footprint_mrad * 1e-3,
            first_shot,
            open_shots,
            rays,
        )
        flicker = np.clip(
            1.0 + self._options.intensity_noise * rng.standard_normal((len(origins) // rays, 2)), 0.05, None
        )
        opaque, materials = self.surfaces.opaque(origins, directions), np.zeros(0, np.uint8)
        if self._traffic is not None:
            firing, reach_m = np.nonzero(open_shots)[0], self._options.max_range_m
            moved = self._traffic.meet(time_s, firing, origins, directions, opaque, self.surfaces.planes, reach_m)
            materials = self._traffic.material[moved[1]]
        echoes = form(
            origins,
            directions,
            opaque,
            self.surfaces.clear(origins, directions),
            self.surfaces.planes,
            self._world.material,
            self._tables,
            rays,
            flicker,
            self._threshold,
            self._options.max_range_m,
            moved[0],
            materials,
        )
        return origins[::rays], directions[::rays], echoes, moved

    def _airframe(self, turn_deg: Array, step_deg: float) -> Array:
        """Airframe ranges of all shots [m], 0 where the view is free, shape (n, 32)."""
        if not self._options.airframe:
            return np.zeros((len(turn_deg), LASERS))
        azimuth = turn_deg[:, None] + step_deg * np.arange(LASERS) * LASER_NS / FIRING_NS
        return airframe_range(azimuth, ELEVATION_DEG)

    def _returns(
        self, echoes: Array, open_shots: npt.NDArray[np.bool_], airframe_m: Array, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Ranges with noise [m] and strengths, shape (n, 32, 1), or (n, 32, 2) in dual mode: even and odd block."""
        if self._mode == ReturnMode.DUAL:
            choice = echoes[:, [LAST, STRONGEST]]
            strongest_is_last = echoes[:, LAST, RANGE] == echoes[:, STRONGEST, RANGE]
            swap = strongest_is_last & (echoes[:, SECOND, RANGE] > 0)
            choice[swap, 1] = echoes[swap, SECOND]
        else:
            choice = echoes[:, [LAST if self._mode == ReturnMode.LAST else STRONGEST]]
        ranges = np.repeat(airframe_m[..., None], choice.shape[1], axis=2)
        strengths: Array = np.full(ranges.shape, _AIRFRAME_STRENGTH)
        ranges[open_shots], strengths[open_shots] = choice[..., RANGE], choice[..., STRENGTH]
        noise = self._options.range_noise_m * np.asarray(rng.standard_normal(ranges.shape))
        same = ranges[..., -1] == ranges[..., 0]  # one echo in both blocks carries one noise
        noise[same, -1] = noise[same, 0]
        noisy = ranges + noise + self._bias_m[:, None]
        return np.where(ranges > 0, np.maximum(noisy, RANGE_LSB_M), 0.0), strengths

    def _pack(
        self, first: int, count: int, turn_deg: Array, ranges: Array, strengths: Array, rng: np.random.Generator
    ) -> npt.NDArray[np.void]:
        packets = np.zeros(count, DATA_DTYPE)
        blocks = packets["blocks"]
        blocks["flag"] = BLOCK_FLAG
        reported = turn_deg + self._options.encoder_noise_deg * rng.standard_normal(turn_deg.shape)
        # rounded after it is brought into the circle, so that 36000 does occur [measured]
        azimuth = np.rint(reported % 360.0 * 100.0).astype(np.uint16)
        steps = np.rint(ranges / RANGE_LSB_M).astype(np.uint16)
        values = intensity(strengths)
        # a slot without return carries an intensity all the same, mostly 1 [measured]
        one = values.shape[:2]
        stray = np.where(rng.random(one) < 0.06, rng.integers(2, 256, one), 1).astype(np.uint8)
        values = np.where(steps > 0, values, stray[..., None])
        if self._mode == ReturnMode.DUAL:
            azimuth = np.repeat(azimuth, 2)
            steps, values = np.moveaxis(steps, 2, 1), np.moveaxis(values, 2, 1)
        else:
            steps, values = steps[..., 0], values[..., 0]
        blocks["azimuth"] = azimuth.reshape(count, BLOCKS)
        blocks["returns"]["range"] = steps.reshape(count, BLOCKS, LASERS)
        blocks["returns"]["intensity"] = values.reshape(count, BLOCKS, LASERS)
        stamp_ns = self._clock.start_ns + (first + np.arange(count)) * packet_ns(self._mode)
        packets["stamp_us"] = stamp_ns // NS_PER_US % STAMP_WRAP_US
        packets["return_mode"], packets["product"] = self._mode, PRODUCT_ID
        return packets

    def _truth(
        self,
        echoes: Array,
        open_shots: npt.NDArray[np.bool_],
        origins: npt.NDArray[np.float32],
        directions: npt.NDArray[np.float32],
        firing_ns: npt.NDArray[np.int64],
        moved: _Moved,
    ) -> npt.NDArray[np.void]:
        firing, laser = np.nonzero(open_shots)
        order = {ReturnMode.LAST: [LAST], ReturnMode.DUAL: [STRONGEST, LAST]}.get(self._mode, [STRONGEST])
        parts = []
        for number, which in enumerate(order):
            echo = echoes[:, which]
            if (
                number == 1
            ):  # of a pair that is one echo nothing is left; where the last is the strongest, the second counts
                one = echo[:, RANGE] == echoes[:, STRONGEST, RANGE]
                echo = np.where(one[:, None], echoes[:, SECOND], echo)
            kept = echo[:, RANGE] > 0
            truth = np.zeros(int(kept.sum()), TRUTH_DTYPE)
            point = origins[kept].astype(np.float64) + directions[kept] * echo[kept, RANGE, None]
            truth["x"], truth["y"], truth["z"] = point.T
            truth["lidar_ns"] = firing_ns[firing[kept]] + laser[kept] * LASER_NS
            truth["range_m"], truth["mixed"] = echo[kept, RANGE], echo[kept, MIXED] > 0
            truth["triangle"] = echo[kept, TRIANGLE]
            self._name(truth, moved)
            truth["laser"], truth["number"] = laser[kept], number
            parts.append(truth)
        merged = np.concatenate(parts)
        return merged[np.argsort(merged["lidar_ns"], kind="stable")]

    def _name(self, truth: npt.NDArray[np.void], moved: _Moved) -> None:
        """Fill in normal and surface by the triangle; what moves has none, and its surface counts on from the world's."""
        planes, box = moved
        triangles = len(self.surfaces.planes)
        away = np.flatnonzero(truth["triangle"] >= triangles)
        row = truth["triangle"][away] - triangles
        truth["triangle"][away] = -1
        truth["normal"] = self.surfaces.planes[truth["triangle"], :3]
        truth["surface"] = self._world.surface[truth["triangle"]]
        if self._traffic is not None and len(away):
            truth["normal"][away] = planes[row, :3]
            truth["surface"][away] = len(self._world.names) + self._traffic.owner[box[row]]
