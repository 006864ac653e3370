"""The contents of a flight log and their meaning: the contract between aircraft, ground and simulator.

Conventions, once for the whole project
---------------------------------------
Frames
    sensor  the lidar's own: x right (cable side), y forward (azimuth 0), z up along the spin axis
    ins     body of the autopilot board that measures: x right, y forward, z up; origin at its IMU
    local   level: x east, y north, z up, tangent plane at a stated origin ("enu")
    MAVLink uses FRD and NED; `frames` converts them on input.
Rotations
    Row vectors as in the source of the geometry: p_b = p_a @ rot. In `frames`, rotation(yaw, pitch, roll) is its
    R(g, a, b). mat_ab is a column-form matrix "a from b", p_a = mat_ab @ p_b; quat_ab_wxyz is the same as a unit
    quaternion, scalar first. Heading is clockwise from true north; yaw is counter-clockwise seen from above. Pitch is
    positive nose up, roll is positive right wing down.
Units
    SI and radians inside; degrees in configuration, on the wire and in reports. Names state the unit (range_m,
    heading_deg).
Time
    Always int nanoseconds of a named scale. The scales:
    log      receive time in the log: the host's wall clock at the start, continued by its monotonic clock; never steps
    lidar    the lidar's own clock: microseconds past the hour, unwrapped and put on an hour
    boot     the autopilot's time since boot, unwrapped; one scale for each boot
    utc      Unix time (leap seconds not counted)
    gps      seconds since 1980-01-06 (leap seconds counted)
    Raw stamps are kept for ever; a corrected time is a new field.
Loss
    Every dropped packet, byte, message or point adds to a named counter that reaches log, health and report.

Map
---
errors, constants, config     the tree of errors; constants with source; YAML to frozen dataclasses
clock, nmea                   time scales and how stamps unwrap; GPRMC
frames, mount                 rotations; where lidar and antennas sit on the airframe
hdl32e, mavlink, dataflash    the sensors' wire formats
records                       THE table of topics, and the bytes of each record
logwriter, logfile            writing a log; reading one, cut off or damaged ones too
salvage                       a whole log out of a cut or damaged one
vehicles, signing, words      who the autopilot is on a link, and whether it is he; text from outside, made harmless
container, mcapwriter, walk   the records of an MCAP file; writing them; reading past damage
"""

from flightlog.constants import FORMAT_VERSION

__all__ = ["FORMAT_VERSION", "__version__"]


def __getattr__(name: str) -> str:
    """The version, looked up only on request: the look-up takes longer than a short command."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("swath")
    except PackageNotFoundError:  # a source tree that is not installed
        return "0+unknown"
