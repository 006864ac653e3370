"""Where the sensors sit on the airframe: lever arms and boresight, as a frozen value and as YAML."""

import dataclasses
import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flightlog import config
from flightlog.config import option
from flightlog.frames import rotation


@dataclass(frozen=True, slots=True)
class LidarMount:
    """Pose of the lidar in the ins frame (x right, y forward, z up): step 2 of the source's geometry, trims included."""

    position_m: tuple[float, float, float] = option(
        (0.0, 0.0, -0.16), "optical centre in the ins frame: right, forward, up [m]", minimum=-5, maximum=5
    )
    yaw_deg: float = option(0.0, "counter-clockwise seen from above [deg]", minimum=-360, maximum=360)
    pitch_deg: float = option(-20.0, "nose up; tilted 20 deg forward is -20 [deg]", minimum=-180, maximum=180)
    roll_deg: float = option(0.0, "right side down [deg]", minimum=-180, maximum=180)


@dataclass(frozen=True, slots=True)
class Mount:
    """Everything that is bolted to the airframe."""

    lidar: LidarMount = option(LidarMount, "the HDL-32E")
    gps_position_m: tuple[float, float, float] | None = option(
        None,
        "antenna of the autopilot's GPS in the ins frame: right, forward, up [m]; "
        "null: the autopilot already refers its position to its IMU",
        minimum=-5,
        maximum=5,
    )

    def mat_ins_lidar(self) -> npt.NDArray[np.float64]:
        """Column matrix "ins from sensor", shape (3, 3)."""
        return _mat_ins_lidar(self.lidar)

    def lidar_position_m(self) -> npt.NDArray[np.float64]:
        """Lever arm of the lidar in the ins frame [m], shape (3,)."""
        return np.array(self.lidar.position_m)

    def with_lidar(self, **named: Any) -> "Mount":
        """A mount with some values of the lidar changed."""
        return dataclasses.replace(self, lidar=dataclasses.replace(self.lidar, **named))

    def yaml(self) -> str:
        """The text of a mount file."""
        return config.dump(self)


def load_mount(path: str | Path) -> Mount:
    """Read a mount file; ConfigError where it is not one."""
    return config.load(path, Mount)


def parse_mount(text: str, place: str) -> Mount:
    """Read the text of a mount file; `place` names it in errors."""
    return config.loads(text, Mount, place)


@functools.lru_cache(maxsize=64)
def _mat_ins_lidar(lidar: LidarMount) -> npt.NDArray[np.float64]:
    mat = rotation(*np.deg2rad([lidar.yaw_deg, lidar.pitch_deg, lidar.roll_deg])).T
    mat.flags.writeable = False
    return mat
