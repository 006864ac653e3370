"""What a lidar model is to the rest of the ground tool, and how one is chosen.

Above this room nobody knows a packet's bytes or a model's constants: a log's records go in, `Shots` come out.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from groundproc.sensors.shots import Gate, LaserTable, Shots

Records = npt.NDArray[np.void]
Times = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Ranging:
    """What a beam knows of its echo.

    Attributes
    ----------
    sigma_m : float
        Of a range at normal incidence, one sigma.
    divergence_rad : float
        Full width of the beam.
    pulse_m : float
        Length of the pulse, as the distance from which on two surfaces give two echoes.
    pointing_rad : float
        Of each angle of the beam as it is stated, one sigma; 0: nobody says.
    """

    sigma_m: float
    divergence_rad: float
    pulse_m: float
    pointing_rad: float = 0.0


class Lidar(Protocol):
    """One model of lidar.

    Attributes
    ----------
    name : str
        As the log and its users have it.
    topic : str
        Of the log, where its records are.
    about : str
        For the header of a cloud, at most 31 characters with what follows it.
    range_step_m : float
        What ranges are whole multiples of; 0: they are not.
    ranging : Ranging
    lasers : LaserTable
        The manual's.
    firing_ns, laser_ns : int
        From one firing to the next, and from one laser to the next within it; shots of one laser are at least `firing_ns` apart.
    idle_ns : int
        From the last shot of a record to the begin of the next one.
    records_s : int
        About how many records come in a second.
    stamp_wraps : bool
        Whether stamps count from the top of the hour; False: they are UTC.
    mode_names : mapping of int to str
        Return modes by their codes.
    """

    name: str
    topic: str
    about: str
    range_step_m: float
    ranging: Ranging
    lasers: LaserTable
    firing_ns: int
    laser_ns: int
    idle_ns: int
    records_s: int
    stamp_wraps: bool
    mode_names: Mapping[int, str]

    def unpack(self, data: bytes | memoryview) -> Records:
        """The records of one message; LogError for other bytes."""

    def receive_time_ns(self, records: Records) -> Times:
        """When each record was received [ns of log time], shape (n,)."""

    def stamp_ns(self, records: Records) -> Times:
        """The sensor's own stamp of each record [ns], shape (n,)."""

    def valid(self, records: Records) -> npt.NDArray[np.bool_]:
        """Which records, of any sensor of the topic, this model could have sent, each looked at alone; shape (n,)."""

    def check(self, records: Records, place: str) -> None:
        """Refuse the records of another model, by their content and timing.

        Raises
        ------
        WrongSensorError
            Names the other model where it is known.
        """

    def same_kind(self, before: Records, after: Records) -> bool:
        """Whether two batches may be decoded as one."""

    def decode(
        self, records: Records, time_ns: Times, gate: Gate | None = None, lasers: LaserTable | None = None
    ) -> Iterator[Shots]:
        """Records and the times of their stamps [ns] into shots, in pieces of one return mode."""

    def blanks(self) -> Iterator[Records]:
        """A few records without a return in each return mode, to compile what decodes them."""

    def digest(self, records: Records) -> "Digest":
        """What `swath info` counts, without decoding."""


@dataclass(frozen=True, slots=True)
class Digest:
    """What records say of themselves before they are decoded.

    Attributes
    ----------
    azimuth_cdeg : ndarray of int64, shape (n, k)
        Azimuths stated in each record [0.01 deg], 0 to 35999.
    mode : ndarray of uint8, shape (n,)
        Return mode as the sensor codes it.
    record_ns : ndarray of int64, shape (n,)
        Nominal time from this record to the next, by its mode.
    returns : int
        Returns in all of them.
    """

    azimuth_cdeg: Times
    mode: npt.NDArray[np.uint8]
    record_ns: Times
    returns: int


@dataclass(frozen=True, slots=True)
class Readings:
    """What the position packets of a lidar hold.

    Attributes
    ----------
    gyro_rad_s, accel_m_s2, temperature_c : ndarray, shape (n, 3)
        Angular rate and specific force in the sensor frame.
    has_imu : ndarray of bool, shape (n,)
        Whether the packet carries readings of the gyros at all.
    pps : ndarray of uint8, shape (n,)
        hdl32e.PpsState.
    sentences : ndarray of bytes, shape (n,)
        The GPS sentence of each, with what follows it.
    """

    gyro_rad_s: npt.NDArray[np.float64]
    accel_m_s2: npt.NDArray[np.float64]
    temperature_c: npt.NDArray[np.float64]
    has_imu: npt.NDArray[np.bool_]
    pps: npt.NDArray[np.uint8]
    sentences: npt.NDArray[np.bytes_]
