"""The one tree of errors that a user can meet.

Every message is one sentence that states the value found, what was expected, and the place (file, key, byte).
Programs show it unchanged and end with `exit_code`. A traceback is for our own mistakes only.
"""


class SwathError(Exception):
    """Anything that went wrong outside the program: input, hardware, files, configuration."""

    exit_code = 1


class UsageError(SwathError):
    """The command line or the configuration asks for something that cannot be."""

    exit_code = 2


class ConfigError(UsageError):
    """A configuration file with an unknown key, a wrong type or a value out of range."""


class PacketError(SwathError):
    """Bytes that are not the packet they should be."""


class WrongSensorError(PacketError):
    """A packet of another lidar model than the HDL-32E."""


class CaptureError(SwathError):
    """A recording (pcap, pcapng, tlog, dataflash) that cannot be read as what it claims to be."""


class LogError(SwathError):
    """A flight log that cannot be read, or does not hold what is needed."""


class ClockError(SwathError):
    """Time stamps that cannot be put on one scale."""


class SyncError(ClockError):
    """Two clocks between which no offset can be found."""


class CoverageError(SwathError):
    """A time outside what a trajectory covers. There is no extrapolation."""


class GeodesyError(SwathError):
    """A coordinate system or a height reference that is unknown or not available."""


class SourceError(SwathError):
    """A device or port that cannot be opened."""
