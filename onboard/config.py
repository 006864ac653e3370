"""What the operator of the aircraft may set; `swathd config` prints the file with every default."""

from dataclasses import dataclass, field
from ipaddress import IPv4Address
from pathlib import Path
from typing import Final

from flightlog import config
from flightlog.config import option
from flightlog.constants import HDL32E_DATA_PORT, HDL32E_POSITION_PORT

_UDP: Final = "udp:"


@dataclass(frozen=True, slots=True)
class FovConfig:
    """The sector that is recorded, clockwise from start to end as the sensor counts its azimuth."""

    start_deg: float = option(255.0, "where it begins, azimuth of the sensor [deg]", minimum=0, maximum=360)
    end_deg: float = option(
        105.0, "where it ends, clockwise; equal to the start: the full circle [deg]", minimum=0, maximum=360
    )


@dataclass(frozen=True, slots=True)
class LidarConfig:
    """The HDL-32E's two UDP ports."""

    address: str = option("0.0.0.0", "local address to listen on; 0.0.0.0 also takes broadcasts")
    data_port: int = option(
        HDL32E_DATA_PORT,
        "port of the data packets; what --lidar-port is in swath import, live and replay",
        minimum=1,
        maximum=65535,
    )
    position_port: int = option(
        HDL32E_POSITION_PORT, "port of the position packets; --position-port there", minimum=1, maximum=65535
    )
    receive_buffer_kb: int = option(
        9216, "kernel receive buffer; 9216 bridges a stall of 4 s [kB]", minimum=16, maximum=262144
    )
    poll_ms: int = option(
        240, "longest pause between two looks at the sockets, 100 with a downlink; receive times are the kernel's [ms]",
        minimum=1, maximum=250,
    )  # fmt: skip
    fov: FovConfig = option(FovConfig, "what is kept; the rest looks at the airframe")
    sensor: str | None = option(
        None, "address of the lidar: packets of all others are refused; null: that of the first good packets"
    )
    interface: str | None = option(
        None, "network interface of the lidar, to tell a pulled cable; null: found by the lidar's address"
    )
    only_interface: bool = option(
        False, "refuse what comes in by any other: where others share the network, a sender's address proves nothing"
    )

    def __post_init__(self) -> None:
        if self.only_interface and self.interface is None:
            raise ValueError("only_interface: true found, expected with a name for interface")
        if self.sensor is not None:
            IPv4Address(self.sensor)


@dataclass(frozen=True, slots=True)
class StreamsConfig:
    """Rates to ask an ArduPilot for; ArduCopter 3.1.3 answers 50 with 25 Hz, its highest."""

    raw_sensors_hz: int = option(50, "RAW_IMU; 0: do not ask for it [Hz]", minimum=0, maximum=400)
    extended_status_hz: int = option(5, "GPS_RAW_INT, SYS_STATUS [Hz]", minimum=0, maximum=400)
    position_hz: int = option(10, "GLOBAL_POSITION_INT [Hz]", minimum=0, maximum=400)
    extra1_hz: int = option(50, "ATTITUDE [Hz]", minimum=0, maximum=400)
    extra2_hz: int = option(2, "VFR_HUD [Hz]", minimum=0, maximum=400)
    extra3_hz: int = option(2, "SYSTEM_TIME, AHRS [Hz]", minimum=0, maximum=400)


@dataclass(frozen=True, slots=True)
class LinkConfig:
    """One MAVLink link."""

    device: str | None = field(
        metadata={"about": "serial device, or udp:ADDRESS:PORT to listen on; null: there is no such link"}
    )
    baud: int = option(57600, "of the serial device [baud]", minimum=1200, maximum=4_000_000)
    request_streams: bool | None = option(
        None, "ask the autopilot for the rates below; null: on a serial device yes, on UDP no"
    )
    streams: StreamsConfig = option(StreamsConfig, "rates to ask for")
    signing_key: str | None = option(
        None,
        "file with the key of MAVLink 2 signing: frames without a right signature are recorded, and not believed; null: none",
    )

    def __post_init__(self) -> None:
        if self.device is not None and self.device.startswith(_UDP):
            self.udp_address()

    @property
    def serial(self) -> bool:
        """Whether the device is a serial one."""
        return self.device is not None and not self.device.startswith(_UDP)

    def udp_address(self) -> tuple[str, int]:
        """Address and port of a `udp:` device; ValueError where it is not one."""
        host, _, port = (self.device or "").removeprefix(_UDP).rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 65536:
            raise ValueError(f"device {self.device!r} found, expected udp:ADDRESS:PORT")
        return host, int(port)

    @property
    def requests(self) -> bool:
        """Whether to ask for streams."""
        return self.serial if self.request_streams is None else self.request_streams


@dataclass(frozen=True, slots=True)
class RecorderConfig:
    """Where flight logs go and how often they are made safe."""

    directory: str = option("/var/lib/swathd", "folder of the flight logs; made if it is not there")
    folders: tuple[str, ...] = option(
        (), "further folders, tried in turn where that one cannot be written to; on another card or disk"
    )
    lidar: str = option(
        "always", "when to record the lidar; armed: while the autopilot says so, or cannot be heard; all else always",
        choices=("always", "armed"),
    )  # fmt: skip
    sync_ms: int = option(
        500, "how often the log is forced on to the disk; a power cut loses about this much [ms]",
        minimum=50, maximum=10_000,
    )  # fmt: skip
    backlog_mb: int = option(
        24, "memory for what the disk has not taken yet; 24 holds 10 s [MB]", minimum=1, maximum=1024
    )
    compression: str = option(
        "none", "of the log; zstd makes 0.72 of it for three times the CPU, lz4 0.89", choices=("none", "lz4", "zstd")
    )
    segment_mb: int = option(1024, "size at which a new file is begun [MB]", minimum=1, maximum=65536)
    segment_s: int = option(900, "age at which a new file is begun [s]", minimum=1, maximum=86400)
    min_free_mb: int = option(
        500, "space below which the lidar is not recorded; below a quarter of it nothing is [MB]",
        minimum=1, maximum=1_000_000,
    )  # fmt: skip
    prune_acknowledged: bool = option(
        True, "when space is low, delete the oldest logs that were pulled and acknowledged; no others, ever"
    )


@dataclass(frozen=True, slots=True)
class DownlinkConfig:
    """What goes to the ground live, as UDP; it never harms the recording."""

    address: str | None = option(None, "IP address on the ground, a broadcast address too; null: there is no downlink")
    lidar_port: int = option(HDL32E_DATA_PORT, "port of the data packets there", minimum=1, maximum=65535)
    position_port: int = option(HDL32E_POSITION_PORT, "port of the position packets there", minimum=1, maximum=65535)
    mavlink_port: int = option(14550, "port of the ground station there", minimum=1, maximum=65535)
    mavlink: str = option("ins", "whose bytes go there", choices=("ins", "fc", "none"))
    thin: int = option(
        1, "send one sector of 10 deg in so many, others in each turn: that many turns make a whole scan",
        minimum=1, maximum=36,
    )  # fmt: skip
    rate_kbit_s: int = option(
        20_000, "never send more; the whole sensor is 18,400, in dual return mode 36,800 [kbit/s]",
        minimum=64, maximum=1_000_000,
    )  # fmt: skip

    def __post_init__(self) -> None:
        if self.address is not None:
            try:
                IPv4Address(self.address)
            except ValueError:
                raise ValueError(f"address {self.address!r} found, expected one such as 10.0.0.2") from None

    def ports(self) -> dict[str, int]:
        """Port of each topic that goes down."""
        from flightlog import records  # not for those who only ask for the status file

        ports = {records.LIDAR.topic: self.lidar_port, records.POSITION.topic: self.position_port}
        if self.mavlink != "none":
            ports[records.MAVLINK.topic + self.mavlink] = self.mavlink_port
        return ports


@dataclass(frozen=True, slots=True)
class HealthConfig:
    """Who else is told how it goes."""

    prometheus: str | None = option(
        None,
        "text file for Prometheus' node exporter, written each second, such as /run/swathd/swathd.prom; null: there is none",
    )


@dataclass(frozen=True, slots=True)
class SwathdConfig:
    """Everything `swathd run` needs to know."""

    lidar: LidarConfig = option(LidarConfig, "Velodyne HDL-32E")
    ins: LinkConfig = field(
        default_factory=lambda: LinkConfig(device="/dev/swath-ins"),
        metadata={"about": "MAVLink of the autopilot board that measures; topic /mavlink/ins"},
    )
    fc: LinkConfig = field(
        default_factory=lambda: LinkConfig(device=None),
        metadata={"about": "MAVLink of the board that flies, where it is another one; topic /mavlink/fc"},
    )
    recorder: RecorderConfig = option(RecorderConfig, "flight logs")
    downlink: DownlinkConfig = option(DownlinkConfig, "live view on the ground")
    health: HealthConfig = option(HealthConfig, "how it goes, for monitors")
    mount: str | None = option(
        None, "mount file that goes into every log, relative to this file; null: the nominal mount"
    )
    status_file: str | None = option(
        None, "written every second; null: status.json in systemd's runtime folder, else beside the logs"
    )

    def links(self) -> dict[str, LinkConfig]:
        """The links there are, by name."""
        named = {"ins": self.ins, "fc": self.fc}
        return {name: link for name, link in named.items() if link.device is not None}

    def status_path(self, runtime_directory: str | None) -> Path:
        """Where the status file goes; `runtime_directory` is what systemd says, if it does."""
        if self.status_file is not None:
            return Path(self.status_file)
        return Path(runtime_directory or self.recorder.directory) / "status.json"


def load(path: str | Path) -> SwathdConfig:
    """Read a configuration file; ConfigError where it is not one."""
    return config.load(path, SwathdConfig)
