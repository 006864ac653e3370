"""A Velodyne of the family whose packets have twelve blocks: what a model's file fills in, and what follows from it."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import hdl32e, records
from flightlog.constants import NS_PER_US, STANDARD_GRAVITY_M_S2
from flightlog.errors import WrongSensorError
from flightlog.hdl32e import ReturnMode
from groundproc.sensors import firings
from groundproc.sensors.blocks import block_period_ns, by_mode, data_of, period_fits
from groundproc.sensors.firings import Firing
from groundproc.sensors.model import Digest, Ranging, Readings, Records, Times
from groundproc.sensors.shots import Gate, LaserTable, Shots

_BLANK: Final = 0
"""Return mode and product of old firmware of the HDL-32E."""
RANGING: Final = Ranging(
    sigma_m=0.015, divergence_rad=2.79e-3, pulse_m=0.6, pointing_rad=math.radians(0.01) / math.sqrt(12.0)
)
"""Ranges to 15 mm up to 55 m on a panel of 30 %, two surfaces told apart from 0.6 m: measured on an HDL-32E (FOI-R--4045--SE, appendix
B). The width of the beam is the HDL-32E's manual's, which states angles in steps of 0.01 deg. The VLP-16's manual states 3 cm, which
holds an offset of each laser."""
_MODES: Final = {
    int(ReturnMode.UNKNOWN): "unknown",
    int(ReturnMode.STRONGEST): "strongest",
    int(ReturnMode.LAST): "last",
    int(ReturnMode.DUAL): "dual",
}


@dataclass(frozen=True, slots=True)
class Velodyne:
    """A model; for what the attributes mean see `Lidar`.

    Attributes
    ----------
    product : int
        Byte 1205 of its packets.
    lent_products : tuple of int
        Products of other models that it is known to send too: there the timing has to prove it.
    blank : bool
        Whether old firmware leaves return mode and product 0.
    firing : Firing
    """

    name: str
    product: int
    lasers: LaserTable
    firing: Firing
    firing_ns: int
    laser_ns: int
    lent_products: tuple[int, ...] = ()
    blank: bool = False
    topic: str = records.LIDAR.topic
    range_step_m: float = hdl32e.RANGE_LSB_M
    ranging: Ranging = RANGING
    stamp_wraps: bool = True

    @property
    def about(self) -> str:
        """See Lidar."""
        return f"Velodyne {self.name}"

    @property
    def mode_names(self) -> Mapping[int, str]:
        """See Lidar."""
        return _MODES

    @property
    def idle_ns(self) -> int:
        """See Lidar."""
        return int(self.firing.block_ns - self.firing.offset_ns[-1])

    @property
    def records_s(self) -> int:
        """See Lidar."""
        return round(1e9 / (hdl32e.BLOCKS * self.firing.block_ns))

    def unpack(self, data: bytes | memoryview) -> Records:
        """See Lidar: SCAN_PACKET_DTYPE."""
        return records.decode_scan(data)

    def receive_time_ns(self, packets: Records) -> Times:
        """See Lidar."""
        return records.receive_time_ns(packets)

    def stamp_ns(self, packets: Records) -> Times:
        """See Lidar."""
        return np.asarray(data_of(packets)["stamp_us"].astype(np.int64) * NS_PER_US)

    def valid(self, packets: Records) -> npt.NDArray[np.bool_]:
        """See Lidar: all block flags right, known return mode and product."""
        data = data_of(packets)
        mode, product = data["return_mode"], data["product"]
        known = np.isin(mode, [ReturnMode.STRONGEST, ReturnMode.LAST, ReturnMode.DUAL])
        known &= np.isin(product, [self.product, *self.lent_products])
        if self.blank:
            known |= (mode == _BLANK) & (product == _BLANK)
        return np.asarray((data["blocks"]["flag"] == hdl32e.BLOCK_FLAG).all(axis=1) & known)

    def check(self, packets: Records, place: str) -> None:
        """See Lidar: product byte, and blocks as far apart as this model's."""
        data = data_of(packets)
        mine = self.valid(data)
        if len(data) and hdl32e.is_hdl64e(data).any():
            raise WrongSensorError(
                f"{place}: blocks that start with FF DD are an {hdl32e.HDL_64E}'s; a {self.name} is needed"
            )
        if len(data) and not mine.any():
            product = int(data["product"][0])
            name = f"a {_PRODUCTS[product]}" if product in _PRODUCTS else "an unknown sensor"
            raise WrongSensorError(
                f"{place}: product id 0x{product:02x} is {name}; a {self.name} (0x{self.product:02x}) is needed"
            )
        period_ns = block_period_ns(data[mine])
        lent = bool(len(data)) and bool(np.isin(data["product"][mine], self.lent_products).any())
        if not period_fits(period_ns, self.firing.block_ns) or (lent and period_ns is None):
            found = "unknown" if period_ns is None else f"{period_ns / NS_PER_US:.1f} us apart"
            raise WrongSensorError(
                f"{place}: its blocks are {found}; a {self.name} has {self.firing.block_ns / NS_PER_US:.2f} us"
            )

    def same_kind(self, before: Records, after: Records) -> bool:
        """See Lidar: of one return mode."""
        return bool(data_of(before)["return_mode"][-1] == data_of(after)["return_mode"][0])

    def decode(
        self, packets: Records, time_ns: Times, gate: Gate | None = None, lasers: LaserTable | None = None
    ) -> Iterator[Shots]:
        """See Lidar."""
        for part, times in by_mode(packets, time_ns):
            yield firings.decode(self.firing, part, times, gate, lasers or self.lasers)

    @property
    def nothing_m(self) -> float:
        """Range of the shots without an echo in `with_all_shots`: the least that the sensor could state, and never does."""
        return self.range_step_m

    def with_all_shots(self, packets: Records) -> Records:
        """Packets in which a shot without an echo has one at `nothing_m`, so that `decode` gives every shot that was fired."""
        told = packets.copy()
        ranges = data_of(told)["blocks"]["returns"]["range"]
        ranges[ranges == 0] = 1
        return told

    def blanks(self) -> Iterator[Records]:
        """See Lidar."""
        for mode in (ReturnMode.STRONGEST, ReturnMode.DUAL):
            packets = np.zeros(2, records.SCAN_PACKET_DTYPE)
            packets["data"]["return_mode"] = mode
            yield packets

    def digest(self, packets: Records) -> Digest:
        """See Lidar."""
        data = data_of(packets)
        mode = data["return_mode"]
        whole_ns = hdl32e.BLOCKS * self.firing.block_ns
        return Digest(
            data["blocks"]["azimuth"].astype(np.int64) % hdl32e.AZIMUTH_STEPS,
            mode,
            np.where(mode == ReturnMode.DUAL, whole_ns // 2, whole_ns),
            int(np.count_nonzero(data["blocks"]["returns"]["range"])),
        )


_PRODUCTS: Final = {hdl32e.PRODUCT_ID: "HDL-32E", **hdl32e.OTHER_PRODUCTS}


def position_packets(data: bytes) -> Records:
    """View the bytes of whole position packets, shape (n,), of POSITION_DTYPE."""
    return np.frombuffer(data, hdl32e.POSITION_DTYPE)


def is_position(packets: Records) -> npt.NDArray[np.bool_]:
    """Which packets of POSITION_DTYPE are a Velodyne's, shape (n,)."""
    return hdl32e.is_position(packets)


def readings(packets: Records) -> Readings:
    """What position packets of POSITION_DTYPE, shape (n,), hold; those of a VLP-16 have no gyros and leave their words 0."""
    return Readings(
        np.deg2rad(hdl32e.gyro_deg_s(packets)),
        hdl32e.accel_g(packets) * STANDARD_GRAVITY_M_S2,
        hdl32e.temperature_c(packets),
        hdl32e.has_imu(packets),
        packets["pps"].copy(),
        packets["nmea"],
    )
