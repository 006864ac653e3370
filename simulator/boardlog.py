"""The autopilot's own log on its SD card (dataflash .bin), as ArduCopter 4 writes it.

It records the same beliefs as the MAVLink stream, at the board's rates and with its clock in microseconds. Messages, field letters,
units and multipliers are those of AP_Logger (LogStructure.h of Copter 4.1). The first boot only: a reboot begins another file.
"""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt

from flightlog.clock import utc_to_gps_ns
from flightlog.constants import NS_PER_MS, NS_PER_US
from simulator.cameras import Exposure
from simulator.chance import generator
from simulator.clocks import Clocks
from simulator.config import BoardOptions, Options
from simulator.faults import Outage, Reboot
from simulator.geodesy import Origin, geodetic
from simulator.ins import Belief, Ins

Array = npt.NDArray[np.float64]

HEAD: Final = b"\xa3\x95"
FIX_LATE_S: Final = 0.12
"""A fix is logged this long after its epoch."""
_WEEK_MS: Final = 604_800_000
_STORED: Final = {
    "Q": "<u8", "B": "u1", "H": "<u2", "h": "<i2", "I": "<u4", "i": "<i4", "f": "<f4", "d": "<f8", "b": "i1",
    "c": "<i2", "C": "<u2", "e": "<i4", "L": "<i4", "n": "S4", "N": "S16", "Z": "S64", "M": "u1",
}  # fmt: skip
_SCALES: Final = {"c": 100.0, "C": 100.0, "e": 100.0, "L": 1e7}


@dataclass(frozen=True, slots=True)
class Kind:
    """A message as FMT and FMTU declare it."""

    number: int
    name: str
    letters: str
    labels: str
    units: str
    multipliers: str

    @property
    def dtype(self) -> np.dtype[np.void]:
        """Of a whole message, its head included."""
        fields = [(label, _STORED[letter]) for label, letter in zip(self.labels.split(","), self.letters, strict=True)]
        return np.dtype([("head", "u1", 3), *fields])

    def rows(self, count: int, **columns: Any) -> npt.NDArray[np.void]:
        """Messages, shape (count,), of columns in the units of their labels; others are zero."""
        table = np.zeros(count, self.dtype)
        table["head"] = (*HEAD, self.number)
        letters = dict(zip(self.labels.split(","), self.letters, strict=True))
        for label, values in columns.items():
            letter = letters[label]
            if letter in _SCALES:
                values = np.asarray(values) * _SCALES[letter]
            is_whole = letter not in "nNZfdQ"
            table[label] = np.rint(np.asarray(values, np.float64)) if is_whole else values
        return table


FMT: Final = Kind(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns", "-b---", "-----")
UNIT: Final = Kind(129, "UNIT", "QbZ", "TimeUS,Id,Label", "s--", "F--")
FMTU: Final = Kind(130, "FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds", "s---", "F---")
MULT: Final = Kind(131, "MULT", "Qbd", "TimeUS,Id,Mult", "s--", "F--")
PARM: Final = Kind(64, "PARM", "QNff", "TimeUS,Name,Value,Default", "s---", "F---")
MSG: Final = Kind(91, "MSG", "QZ", "TimeUS,Message", "s-", "F-")
MODE: Final = Kind(65, "MODE", "QMBB", "TimeUS,Mode,ModeNum,Rsn", "s---", "F---")
EV: Final = Kind(66, "EV", "QB", "TimeUS,Id", "s-", "F-")
IMU: Final = Kind(
    160, "IMU", "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz",
    "s#EEEooo--O--zz", "F-000000-----00",
)  # fmt: skip
ATT: Final = Kind(
    67,
    "ATT",
    "QccccCCCCB",
    "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw,AEKF",
    "sddddhhdh-",
    "FBBBBBBBB-",
)
XKF1: Final = Kind(
    68, "XKF1", "QBccCfffffffccce", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH", "s#ddhnnnnmmmkkkm",
    "F-BBB0000000BBBB",
)  # fmt: skip
POS: Final = Kind(69, "POS", "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt", "sDUmmm", "FGG000")
GPS: Final = Kind(
    70, "GPS", "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U", "s#-s-S-DUmnhnh-",
    "F--C-0BGGB000--",
)  # fmt: skip
GPA: Final = Kind(71, "GPA", "QBCCCCfBIH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta", "s#-mmnd-ss", "F-BBBB0-CC")
BARO: Final = Kind(
    72, "BARO", "QBffcfIffB", "TimeUS,I,Alt,Press,Temp,CRt,SMS,Offset,GndTemp,Health", "s#mPOnsmO-", "F-00B0C?0-"
)
MAG: Final = Kind(
    73, "MAG", "QBhhhhhhhhhBI", "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOX,MOY,MOZ,Health,S", "s#GGGGGGGGG-s",
    "F-CCCCCCCCC-F",
)  # fmt: skip
CAM: Final = Kind(
    74, "CAM", "QBHIHLLeeeccC", "TimeUS,I,Img,GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,GPSAlt,R,P,Y", "s#---DUmmmddd", "F----GGBBBBBB"
)  # fmt: skip
KINDS: Final = (FMT, UNIT, FMTU, MULT, PARM, MSG, MODE, EV, IMU, ATT, XKF1, POS, GPS, GPA, BARO, MAG)

_UNITS: Final = {
    "-": "", "s": "s", "d": "deg", "h": "degheading", "k": "deg/s", "E": "rad/s", "o": "m/s/s", "m": "m", "n": "m/s",
    "D": "deglatitude", "U": "deglongitude", "P": "Pa", "G": "Gauss", "O": "degC", "S": "satellites", "z": "Hz",
    "#": "instance", "b": "bytes",
}  # fmt: skip
_MULTIPLIERS: Final = {"-": 0.0, "?": 1.0, "0": 1.0, "B": 1e-2, "C": 1e-3, "F": 1e-6, "G": 1e-7}


class BoardLog:
    """Writes the log of one simulation, stretch by stretch."""

    def __init__(
        self, stream: BinaryIO, ins: Ins, clocks: Clocks, options: Options, origin: Origin, seed: int,
        noted: Sequence[Exposure] = (),
    ) -> None:  # fmt: skip
        self._stream = stream
        self._kinds = (*KINDS, CAM) if len(noted) else KINDS
        self._noted = noted
        self._ins, self._clocks, self._origin, self._seed = ins, clocks, origin, seed
        self._options: BoardOptions = options.board
        self._outage, self._reboot = Outage.of(options.faults), Reboot.of(options.faults)
        self._fix_from_s = options.faults.gnss_from_s
        for part in self._beginning():
            stream.write(part)

    def add(self, start_s: float, end_s: float, chunk: int) -> None:
        """Write what is logged in [start, end); a stretch must follow on the one before."""
        if self._reboot.start_s > 0:
            end_s = min(end_s, self._reboot.start_s)
        if end_s <= start_s:
            return
        rows: list[tuple[int, bytes]] = []
        for number, table in enumerate(self._tables(start_s, end_s, chunk)):
            stamps = table["TimeUS"].tolist()
            size = table.dtype.itemsize
            data = table.tobytes()
            rows += [(stamp * 100 + number, data[i * size : (i + 1) * size]) for i, stamp in enumerate(stamps)]
        self._stream.write(b"".join(data for _, data in sorted(rows)))

    def _beginning(self) -> Iterator[bytes]:
        """Declarations, parameters, the firmware's name and the mode."""
        now_us = int(self._clocks.boot.shows_ns(0.0)) // NS_PER_US
        for kind in self._kinds:
            body = struct.pack(
                "<BB4s16s64s", kind.number, kind.dtype.itemsize, *(
                    text.encode() for text in (kind.name, kind.letters, kind.labels)
                )
            )  # fmt: skip
            yield HEAD + b"\x80" + body
        for letter, unit in _UNITS.items():
            yield UNIT.rows(1, TimeUS=now_us, Id=ord(letter), Label=unit.encode()).tobytes()
        for letter, factor in _MULTIPLIERS.items():
            yield MULT.rows(1, TimeUS=now_us, Id=ord(letter), Mult=factor).tobytes()
        for kind in self._kinds:
            yield FMTU.rows(
                1, TimeUS=now_us, FmtType=kind.number, UnitIds=kind.units.encode(), MultIds=kind.multipliers.encode()
            ).tobytes()
        for name, value in (("SYSID_THISMAV", 1.0), ("GPS_TYPE", 1.0), ("INS_GYRO_FILTER", 20.0)):
            yield PARM.rows(1, TimeUS=now_us, Name=name.encode(), Value=value, Default=value).tobytes()
        yield MSG.rows(1, TimeUS=now_us, Message=b"ArduCopter V4.1.5 (swath simulator)").tobytes()
        yield MODE.rows(1, TimeUS=now_us, Mode=5, ModeNum=5, Rsn=1).tobytes()
        yield EV.rows(1, TimeUS=now_us, Id=10).tobytes()

    def _tables(self, start_s: float, end_s: float, chunk: int) -> Iterator[npt.NDArray[np.void]]:
        o = self._options
        rng = generator(self._seed, "board log", chunk)
        for rate_hz, phase_s, makers in (
            (o.imu_hz, 0.0011, (self._imu,)),
            (o.attitude_hz, 0.0013, (self._att,)),
            (o.position_hz, 0.0017, (self._xkf1, self._pos)),
            (o.gps_hz, FIX_LATE_S, (self._gps, self._gpa)),
            (o.slow_hz, 0.0023, (self._baro, self._mag)),
        ):
            if rate_hz <= 0:
                continue
            first, last = (np.ceil((t - phase_s) * rate_hz - 1e-9) for t in (start_s, end_s))
            time_s = np.arange(first, last) / rate_hz + phase_s
            if not len(time_s):
                continue
            belief_s = time_s - FIX_LATE_S if phase_s == FIX_LATE_S else time_s
            belief = self._ins.belief(belief_s, rng)
            stamp_us = self._clocks.boot.shows_ns(time_s) // NS_PER_US
            for make in makers:
                yield make(time_s, stamp_us, belief)
        own = [one for one in self._noted if start_s <= one.time_s < end_s]
        if own:
            yield self._cam(own, chunk)

    def _cam(self, own: Sequence[Exposure], chunk: int) -> npt.NDArray[np.void]:
        time_s = np.array([one.time_s for one in own])
        b = self._ins.belief(time_s, generator(self._seed, "board log of cameras", chunk))
        week, of_week = np.divmod(
            [utc_to_gps_ns(t) // NS_PER_MS for t in self._clocks.utc.shows_ns(time_s).tolist()], _WEEK_MS
        )
        latitude, longitude, height = geodetic(b.position_m, self._origin)
        up = b.position_m[:, 2]
        angles = np.degrees(b.roll_rad), np.degrees(b.pitch_rad), np.degrees(b.heading_rad) % 360.0
        return CAM.rows(
            len(own), TimeUS=self._clocks.boot.shows_ns(time_s) // NS_PER_US, I=[one.camera for one in own],
            Img=[one.number for one in own], GPSTime=of_week, GPSWeek=week, Lat=latitude, Lng=longitude, Alt=height, RelAlt=up,
            GPSAlt=height, **dict(zip("RPY", angles, strict=True)),
        )  # fmt: skip

    def _imu(self, time_s: Array, stamp_us: npt.NDArray[np.int64], b: Belief) -> npt.NDArray[np.void]:
        del time_s
        columns = {f"Gyr{axis}": b.rates_frd_rad_s[:, i] for i, axis in enumerate("XYZ")}
        columns |= {f"Acc{axis}": b.force_frd_m_s2[:, i] for i, axis in enumerate("XYZ")}
        return IMU.rows(len(stamp_us), TimeUS=stamp_us, T=41.0, GH=1, AH=1, GHz=1000, AHz=1000, **columns)

    def _att(self, time_s: Array, stamp_us: npt.NDArray[np.int64], b: Belief) -> npt.NDArray[np.void]:
        del time_s
        angles = np.degrees(b.roll_rad), np.degrees(b.pitch_rad), np.degrees(b.heading_rad) % 360.0
        columns = dict(zip(("Roll", "Pitch", "Yaw"), angles, strict=True))
        return ATT.rows(len(stamp_us), TimeUS=stamp_us, AEKF=3, **columns)

    def _xkf1(self, time_s: Array, stamp_us: npt.NDArray[np.int64], b: Belief) -> npt.NDArray[np.void]:
        del time_s
        east, north, up = b.velocity_m_s.T
        return XKF1.rows(
            len(stamp_us), TimeUS=stamp_us, Roll=np.degrees(b.roll_rad), Pitch=np.degrees(b.pitch_rad),
            Yaw=np.degrees(b.heading_rad) % 360.0, VN=north, VE=east, VD=-up, PN=b.position_m[:, 1], PE=b.position_m[:, 0],
            PD=-b.position_m[:, 2],
        )  # fmt: skip

    def _pos(self, time_s: Array, stamp_us: npt.NDArray[np.int64], b: Belief) -> npt.NDArray[np.void]:
        del time_s
        latitude, longitude, height = geodetic(b.position_m, self._origin)
        up = b.position_m[:, 2]
        return POS.rows(
            len(stamp_us), TimeUS=stamp_us, Lat=latitude, Lng=longitude, Alt=height, RelHomeAlt=up, RelOriginAlt=up
        )

    def _gps(self, time_s: Array, stamp_us: npt.NDArray[np.int64], b: Belief) -> npt.NDArray[np.void]:
        epoch_ns = self._clocks.utc.shows_ns(time_s - FIX_LATE_S)
        week, of_week = np.divmod([utc_to_gps_ns(t) // NS_PER_MS for t in epoch_ns.tolist()], _WEEK_MS)
        latitude, longitude, height = geodetic(b.position_m, self._origin)
        east, north, up = b.velocity_m_s.T
        lost = np.array([self._outage.holds(float(t)) or t < self._fix_from_s for t in time_s])
        return GPS.rows(
            len(stamp_us), TimeUS=stamp_us, Status=np.where(lost, 1, 3), GMS=of_week, GWk=week, NSats=np.where(lost, 3, 11),
            HDop=np.where(lost, 99.99, 1.2), Lat=latitude, Lng=longitude, Alt=height, Spd=np.hypot(east, north),
            GCrs=np.degrees(np.arctan2(east, north)) % 360.0, VZ=-up, U=1,
        )  # fmt: skip

    def _gpa(self, time_s: Array, stamp_us: npt.NDArray[np.int64], b: Belief) -> npt.NDArray[np.void]:
        del time_s, b
        o = self._options
        return GPA.rows(
            len(stamp_us), TimeUS=stamp_us, VDop=1.8, HAcc=o.stated_sigma_m, VAcc=1.5 * o.stated_sigma_m, SAcc=0.3, VV=1,
            SMS=stamp_us // 1000, Delta=200,
        )  # fmt: skip

    def _baro(self, time_s: Array, stamp_us: npt.NDArray[np.int64], b: Belief) -> npt.NDArray[np.void]:
        del time_s
        height_m = self._origin.height_msl_m + b.baro_height_m
        pascal = 101_325.0 * (1 - 2.25577e-5 * height_m) ** 5.25588
        return BARO.rows(
            len(stamp_us),
            TimeUS=stamp_us,
            Alt=b.baro_height_m,
            Press=pascal,
            Temp=31.5,
            SMS=stamp_us // 1000,
            Health=1,
        )

    def _mag(self, time_s: Array, stamp_us: npt.NDArray[np.int64], b: Belief) -> npt.NDArray[np.void]:
        del time_s
        columns = {f"Mag{axis}": b.field_frd_mgauss[:, i] for i, axis in enumerate("XYZ")}
        return MAG.rows(len(stamp_us), TimeUS=stamp_us, Health=1, S=stamp_us % 2**32, **columns)
