"""Every option of the simulator: what is in the world is the scene's; what is wrong with the instruments stands here.

The defaults are those of wire.md's measurements on real units and of low-cost autopilots; `perfect` takes every error out.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, Final

from flightlog.config import option


@dataclass(frozen=True, slots=True)
class LidarOptions:
    """The HDL-32E's beams and rotor."""

    rpm: float = option(600.0, "rotor speed [1/min]", minimum=300, maximum=1200)
    returns: str = option("strongest", "return mode", choices=("strongest", "last", "dual"))
    range_noise_m: float = option(0.015, "noise of a range, one sigma [m]", minimum=0, maximum=1)
    laser_bias_m: float = option(
        0.0, "constant range error of each laser, one sigma over lasers [m]", minimum=0, maximum=1
    )
    elevation_error_deg: float = option(
        0.0, "constant error of each laser's elevation, one sigma over lasers [deg]", minimum=0, maximum=5
    )
    intensity_noise: float = option(
        0.15, "fluctuation of a return's strength, one sigma, relative", minimum=0, maximum=1
    )
    encoder_noise_deg: float = option(0.004, "noise of the azimuth reported, one sigma [deg]", minimum=0, maximum=1)
    footprint_mrad: float = option(2.79, "full divergence of a beam; 0: a line [mrad]", minimum=0, maximum=20)
    blind_beyond_m: float = option(
        21.5, "distance at which the 4.6 % panel is lost [m]; sets the detection threshold", minimum=1, maximum=1e4
    )
    max_range_m: float = option(100.0, "no return from beyond [m]", minimum=1, maximum=131)
    airframe: bool = option(True, "legs and body return short ranges outside +-105 deg")
    dark: bool = option(False, "cast no rays: only the airframe returns anything; quick, for tests of clocks and rates")


@dataclass(frozen=True, slots=True)
class GyroOptions:
    """Gyros and accelerometers inside the lidar, as its position packets carry them."""

    offset_deg_s: tuple[float, float, float] = option(
        (-23.1, -7.1, -12.3), "zero offsets of gyro 1, 2, 3 [deg/s]; tens are normal", minimum=-150, maximum=150
    )
    noise_deg_s: float = option(1.1, "white noise of a sample, one sigma [deg/s]", minimum=0, maximum=50)
    rotor_line_deg_s: tuple[float, float, float] = option(
        (0.5, 0.6, 0.2), "amplitude at the rotor's frequency of gyro 1, 2, 3 [deg/s]", minimum=0, maximum=50
    )
    accel_noise_g: float = option(0.015, "white noise of a sample, one sigma [g]", minimum=0, maximum=2)
    accel_rotor_line_g: float = option(0.04, "amplitude at the rotor's frequency [g]", minimum=0, maximum=2)
    accel_bias_g: float = option(
        0.0, "constant error of the force along each axis, one sigma over seeds [g]", minimum=0, maximum=2
    )
    offset_walk_deg_s: float = option(
        0.0, "random walk of the zero offsets, one sigma after a minute [deg/s]", minimum=0, maximum=10
    )
    delay_s: float = option(
        0.0, "readings are older than their stamps by this, accelerometers' too [s]", minimum=-0.1, maximum=0.1
    )
    scale: float = option(
        0.0, "scale factor error of each gyro, one sigma over seeds, relative", minimum=0, maximum=0.5
    )
    scale_fixed: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), "and on top of it for gyro 1, 2, 3, relative", minimum=-0.5, maximum=0.5
    )
    misalignment_deg: float = option(
        0.0, "tilt of each gyro's axis towards each other one, one sigma over seeds [deg]", minimum=0, maximum=10
    )


@dataclass(frozen=True, slots=True)
class ClockOptions:
    """What each clock shows, and how fast it goes."""

    start_utc: str = option("2026-05-20T10:17:03Z", "UTC at the start")
    host_error_s: float = option(0.8, "host clock minus UTC at the start [s]", minimum=-1e9, maximum=1e9)
    host_drift_ppm: float = option(3.0, "host clock fast by [ppm]", minimum=-1000, maximum=1000)
    lidar_on_s: float = option(1012.25, "how long the lidar has been on at the start [s]", minimum=0, maximum=1e6)
    lidar_drift_ppm: float = option(
        58.0, "lidar clock fast by [ppm], where no GPS steers it", minimum=-1000, maximum=1000
    )
    lidar_gps: bool = option(
        False, "the lidar has its own GPS: stamps are microseconds past the UTC hour, GPRMC is there"
    )
    boot_s: float = option(83.412, "how long the INS has been on at the start [s]", minimum=0, maximum=5e6)
    boot_drift_ppm: float = option(-12.0, "INS clock fast by [ppm]", minimum=-1000, maximum=1000)
    arrival_jitter_us: float = option(
        30.0, "jitter of the lidar packets' arrival, one sigma [us]", minimum=0, maximum=1e5
    )


@dataclass(frozen=True, slots=True)
class FlightOptions:
    """Motion: along which route, how fast, and what comes on top."""

    route: str = option("", "which of the scene's routes; empty: its first")
    speed_m_s: float = option(0.0, "speed along the route; 0: the route's own [m/s]", minimum=0, maximum=50)
    higher_m: float = option(0.0, "the route lies so much higher [m]", minimum=-100, maximum=1000)
    vibration_deg: float = option(
        0.03, "rotor vibration of each attitude angle, rms [deg], 15 to 40 Hz", minimum=0, maximum=5
    )
    buzz_deg_s: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0),
        "vibration of the motors and blades, rate of heading, pitch, roll, rms [deg/s], 85 to 240 Hz: faster than gyros are read",
        minimum=0,
        maximum=50,
    )
    gust_deg: float = option(
        0.0,
        "what gusts and control make of each attitude angle beyond its wander, rms [deg], 3 to 20 Hz",
        minimum=0,
        maximum=5,
    )
    wander_deg: float = option(
        1.6, "tilt from gusts and control, rms of roll and of pitch [deg]", minimum=0, maximum=10
    )
    drag_1_s: float = option(
        0.25, "air drag per mass: a multirotor leans into its own speed [1/s]", minimum=0, maximum=5
    )


@dataclass(frozen=True, slots=True)
class InsOptions:
    """Errors of the autopilot's estimates; GM: a first-order Gauss-Markov process of that sigma."""

    gnss_sigma_m: float = option(2.0, "horizontal position, GM [m]", minimum=0, maximum=100)
    gnss_tau_s: float = option(60.0, "its time constant [s]", minimum=0.1, maximum=1e5)
    multipath_m: float = option(
        0.0,
        "what walls near by do to horizontal positions, one sigma an axis, bound to the place [m]",
        minimum=0,
        maximum=100,
    )
    multipath_length_m: float = option(12.0, "way over which that changes [m]", minimum=0.1, maximum=1e4)
    position_noise_m: float = option(0.05, "white noise of a position [m]", minimum=0, maximum=100)
    height_bias_m: float = option(1.5, "constant height error, one sigma over seeds [m]", minimum=0, maximum=100)
    baro_walk_m: float = option(0.3, "random walk of the height, one sigma after a minute [m]", minimum=0, maximum=100)
    tilt_sigma_deg: float = option(0.5, "roll and pitch, GM with tau 8 s [deg]", minimum=0, maximum=45)
    heading_sigma_deg: float = option(1.0, "heading, GM with tau 8 s [deg]", minimum=0, maximum=90)
    compass_bias_deg: float = option(
        8.0,
        "amplitude of the compass error that turns with heading [deg]; with 0.3 of it twice per turn",
        minimum=0,
        maximum=90,
    )
    compass_phase_deg: tuple[float, float] | None = option(
        None,
        "at which headings that error is: phase of its first and second harmonic, the same in every run [deg]; null: by seed",
        minimum=-360,
        maximum=360,
    )
    compass_offset_deg: float = option(1.5, "constant heading error [deg]", minimum=-180, maximum=180)
    gyro_noise_deg_s: float = option(0.15, "white noise of a rate, one sigma [deg/s]", minimum=0, maximum=50)
    gyro_bias_deg_s: float = option(
        0.3, "constant error of each rate, one sigma over seeds [deg/s]", minimum=0, maximum=50
    )
    gyro_walk_deg_s: float = option(
        0.0, "random walk of that error, one sigma after a minute [deg/s]", minimum=0, maximum=10
    )
    gyro_scale: float = option(
        0.0, "scale factor error of each gyro, one sigma over seeds, relative", minimum=0, maximum=0.5
    )
    gyro_scale_fixed: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), "and on top of it: right, forward, up, relative", minimum=-0.5, maximum=0.5
    )
    gyro_misalignment_deg: float = option(
        0.0, "tilt of each gyro's axis towards each other one, one sigma over seeds [deg]", minimum=0, maximum=10
    )
    gyro_filter_hz: float = option(20.0, "low-pass of the gyros [Hz]; takes vibration away", minimum=0.1, maximum=1000)
    gyro_delay_s: float = option(
        0.0, "delay of that filter: states are this much older than stamped [s]", minimum=0, maximum=1
    )
    position_delay_s: float = option(
        0.0, "positions and velocities are older than stamped by this beyond that delay [s]", minimum=0, maximum=5
    )
    accel_noise_m_s2: float = option(0.3, "white noise of a specific force, one sigma [m/s^2]", minimum=0, maximum=50)
    accel_bias_m_s2: float = option(
        0.0, "constant error of each specific force, one sigma over seeds [m/s^2]", minimum=0, maximum=10
    )
    accel_walk_m_s2: float = option(
        0.0, "random walk of that error, one sigma after a minute [m/s^2]", minimum=0, maximum=10
    )
    accel_scale: float = option(
        0.0, "scale factor error of each accelerometer, one sigma over seeds, relative", minimum=0, maximum=0.5
    )
    accel_scale_fixed: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), "and on top of it: right, forward, up, relative", minimum=-0.5, maximum=0.5
    )
    accel_misalignment_deg: float = option(
        0.0,
        "tilt of each accelerometer's axis towards each other one, one sigma over seeds [deg]",
        minimum=0,
        maximum=10,
    )


@dataclass(frozen=True, slots=True)
class LinkOptions:
    """The autopilot's MAVLink: version, rates, latency."""

    version: int = option(1, "MAVLink version", choices=(1, 2))
    firmware: str = option(
        "3.1.3", "3.1.3: 50 Hz ticks, 25 Hz at most; modern: rates as asked", choices=("3.1.3", "modern")
    )
    raw_sensors_hz: float = option(50.0, "rate asked for RAW_IMU, SCALED_PRESSURE", minimum=0, maximum=1000)
    extra1_hz: float = option(50.0, "rate asked for ATTITUDE", minimum=0, maximum=1000)
    position_hz: float = option(10.0, "rate asked for GLOBAL_POSITION_INT", minimum=0, maximum=1000)
    status_hz: float = option(4.0, "rate asked for GPS_RAW_INT, SYS_STATUS", minimum=0, maximum=1000)
    extra2_hz: float = option(4.0, "rate asked for VFR_HUD", minimum=0, maximum=1000)
    extra3_hz: float = option(2.0, "rate asked for SYSTEM_TIME", minimum=0, maximum=1000)
    system_time: str = option(
        "exact",
        "unix time in SYSTEM_TIME: exact, or that of the last GPS epoch as 3.1.3 sends",
        choices=("exact", "epoch"),
    )
    position_stamp: str = option(
        "built",
        "stamp of GLOBAL_POSITION_INT: when it was built, or when the last fix came in, as 3.1.3 has it",
        choices=("built", "fix"),
    )
    stamp_jitter_s: float = option(
        0.005,
        "a message's state is older or younger than its stamp by up to [s], uniform about zero",
        minimum=0,
        maximum=1,
    )
    latency_s: float = option(0.012, "shortest time from building to receiving [s]", minimum=0, maximum=10)
    latency_jitter_s: float = option(0.006, "mean of what comes on top, exponential [s]", minimum=0, maximum=10)


@dataclass(frozen=True, slots=True)
class BoardOptions:
    """The log on the autopilot's own card: rates and what its receiver states."""

    imu_hz: float = option(50.0, "rate of IMU; 400 with IMU_FAST", minimum=0, maximum=1000)
    attitude_hz: float = option(25.0, "rate of ATT", minimum=0, maximum=400)
    position_hz: float = option(10.0, "rate of POS and XKF1", minimum=0, maximum=400)
    gps_hz: float = option(5.0, "rate of GPS and GPA", minimum=0, maximum=20)
    slow_hz: float = option(10.0, "rate of BARO and MAG", minimum=0, maximum=100)
    stated_sigma_m: float = option(1.8, "horizontal accuracy that the receiver states [m]", minimum=0, maximum=100)


@dataclass(frozen=True, slots=True)
class RtkOptions:
    """A second receiver whose phases are solved against a base: rtk.pos, as RTKLIB writes it."""

    hz: float = option(0.0, "positions a second; 0: no such receiver", minimum=0, maximum=20)
    sigma_m: tuple[float, float, float] = option((0.02, 0.02, 0.03), "error east, north, up, GM", minimum=0, maximum=10)
    tau_s: float = option(10.0, "its time constant; 0: each position by itself [s]", minimum=0, maximum=1e5)


@dataclass(frozen=True, slots=True)
class MountOptions:
    """How the true mount differs from the nominal one that is written into the log."""

    lidar_position_m: tuple[float, float, float] | None = option(
        None, "nominal lever arm of the lidar: right, forward, up [m]; null: the scene's", minimum=-5, maximum=5
    )
    lidar_deg: tuple[float, float, float] | None = option(
        None, "nominal yaw, pitch, roll of the lidar [deg]; null: the scene's", minimum=-180, maximum=180
    )
    boresight_deg: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), "true minus nominal yaw, pitch, roll of the lidar [deg]", minimum=-20, maximum=20
    )
    lever_m: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), "true minus nominal lever arm: right, forward, up [m]", minimum=-1, maximum=1
    )
    boresight_spread_deg: float = option(
        0.0, "yaw, pitch and roll are off by up to this on top, uniform over seeds [deg]", minimum=0, maximum=20
    )
    lever_spread_m: float = option(
        0.0, "right, forward and up are off by up to this on top, uniform over seeds [m]", minimum=0, maximum=1
    )
    gps_position_m: tuple[float, float, float] | None = option(
        None,
        "antenna of the GPS as the log's mount has it: right, forward, up [m]; positions are those of the antenna; "
        "null: the log's mount names none",
        minimum=-5,
        maximum=5,
    )
    gps_error_m: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0),
        "true minus nominal place of the antenna, from the INS where none is named [m]",
        minimum=-5,
        maximum=5,
    )


@dataclass(frozen=True, slots=True)
class MovingOptions:
    """What moves in the scene, on ways of its own."""

    cars: int = option(0, "cars that drive at 6 to 9 m/s", minimum=0, maximum=200)
    people: int = option(0, "people who walk at 1.1 to 1.6 m/s", minimum=0, maximum=200)


@dataclass(frozen=True, slots=True)
class FaultOptions:
    """What goes wrong in flight; a time of 0 s: it does not."""

    reboot_at_s: float = option(0.0, "the INS reboots at [s]", minimum=0, maximum=1e6)
    reboot_silence_s: float = option(6.0, "and is silent for [s]", minimum=0, maximum=1e4)
    lidar_gap_at_s: float = option(
        0.0, "the lidar's cable is out, neither data nor position packets come, from [s]", minimum=0, maximum=1e6
    )
    lidar_gap_s: float = option(0.5, "for [s]", minimum=0, maximum=1e4)
    lidar_loss: float = option(0.0, "share of the lidar's packets that get lost, one by one", minimum=0, maximum=1)
    gnss_gap_at_s: float = option(
        0.0,
        "the GPS has no fix from [s]: GPS_RAW_INT says so, GLOBAL_POSITION_INT goes on by dead reckoning",
        minimum=0,
        maximum=1e6,
    )
    gnss_gap_s: float = option(30.0, "for [s]", minimum=0, maximum=1e4)
    gnss_glitch_at_s: float = option(
        0.0,
        "positions are off by gnss_glitch_m from [s]: a glitch, multipath or another height",
        minimum=0,
        maximum=1e6,
    )
    gnss_glitch_s: float = option(2.0, "for [s]", minimum=0, maximum=1e6)
    gnss_glitch_rise_s: float = option(
        0.0, "which they take to get there, and as long to come back [s]", minimum=0, maximum=1e4
    )
    gnss_glitch_m: tuple[float, float, float] = option(
        (30.0, 0.0, 0.0), "east, north, up [m]", minimum=-1e5, maximum=1e5
    )
    gnss_glitch_velocity: bool = option(
        False, "velocities go along, as those of a filter do that follows its receiver; else they stay right"
    )
    gnss_from_s: float = option(
        0.0, "the first fix comes at [s]: before, GPS_RAW_INT and GLOBAL_POSITION_INT are zero", minimum=0, maximum=1e6
    )
    garbage_per_s: float = option(0.0, "bursts of line noise on the MAVLink bytes [1/s]", minimum=0, maximum=100)


@dataclass(frozen=True, slots=True)
class Options:
    """All options of a simulation."""

    lidar: LidarOptions = option(LidarOptions, "beams and rotor")
    gyros: GyroOptions = option(GyroOptions, "gyros and accelerometers inside the lidar")
    clocks: ClockOptions = option(ClockOptions, "clocks")
    flight: FlightOptions = option(FlightOptions, "motion")
    ins: InsOptions = option(InsOptions, "errors of the autopilot's estimates")
    link: LinkOptions = option(LinkOptions, "MAVLink link")
    board: BoardOptions = option(BoardOptions, "the log on the autopilot's own card")
    rtk: RtkOptions = option(RtkOptions, "positions of centimetres")
    mount: MountOptions = option(MountOptions, "true mount against nominal")
    moving: MovingOptions = option(MovingOptions, "what moves in the scene")
    faults: FaultOptions = option(FaultOptions, "what goes wrong")
    truth_hz: float = option(500.0, "rate of truth.csv [Hz]", minimum=100, maximum=2000)
    capture_resolution: str = option("us", "resolution of the pcap's stamps", choices=("us", "ns"))


PARTS: Final = ("lidar", "ins", "all")
"""What `perfect` can take the errors out of."""


def perfect(options: Options, part: str = "all") -> Options:
    """The same world with perfect instruments.

    Parameters
    ----------
    options : Options
    part : str
        lidar: no noise in its ranges, azimuths, gyros and arrival times. ins: no error in what the autopilot believes, its stamps
        exact, no rotor vibration, which its messages are too rare to follow. all: both. Clocks keep offset and drift, the beams
        their footprint; mount and faults stay as they are.
    """
    if part in ("lidar", "all"):
        options = dataclasses.replace(
            options,
            lidar=dataclasses.replace(
                options.lidar,
                range_noise_m=0.0,
                laser_bias_m=0.0,
                elevation_error_deg=0.0,
                intensity_noise=0.0,
                encoder_noise_deg=0.0,
            ),
            gyros=GyroOptions((0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0), 0.0, 0.0),
            clocks=dataclasses.replace(options.clocks, arrival_jitter_us=0.0),
        )
    if part in ("ins", "all"):
        kept = ("gnss_tau_s", "gyro_filter_hz", "compass_phase_deg")
        fields = [field for field in dataclasses.fields(InsOptions) if field.name not in kept]
        zeros: dict[str, Any] = {
            field.name: (0.0, 0.0, 0.0) if isinstance(field.default, tuple) else 0.0 for field in fields
        }
        options = dataclasses.replace(
            options,
            flight=dataclasses.replace(options.flight, vibration_deg=0.0, buzz_deg_s=(0.0, 0.0, 0.0), gust_deg=0.0),
            ins=dataclasses.replace(options.ins, **zeros),
            link=dataclasses.replace(options.link, stamp_jitter_s=0.0, latency_jitter_s=0.0),
        )
    return options
