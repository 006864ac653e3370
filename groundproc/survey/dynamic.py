"""Every number of the dynamic calibration: the source's own, and those of what makes it robust."""

from dataclasses import dataclass, replace
from typing import Final

from flightlog.config import option

SOURCE: Final = "source"
ROBUST: Final = "robust"


@dataclass(frozen=True, slots=True)
class StepOptions:
    """Changes of each trim that are tried in a revolution, in the order in which the variables are tried; the first is none."""

    yaw_deg: tuple[float, ...] = option((0.0, 0.08, -0.08, 0.4, -0.4), "yaw [deg]", minimum=-5, maximum=5)
    altitude_m: tuple[float, ...] = option((0.0, 0.01, -0.01, 0.04, -0.04), "altitude [m]", minimum=-1, maximum=1)
    pitch_deg: tuple[float, ...] = option((0.0, 0.07, -0.07), "pitch [deg]", minimum=-5, maximum=5)
    roll_deg: tuple[float, ...] = option((0.0, 0.07, -0.07), "roll [deg]", minimum=-5, maximum=5)
    x_m: tuple[float, ...] = option((0.0, 0.015, -0.015), "east [m]", minimum=-1, maximum=1)
    y_m: tuple[float, ...] = option((0.0, 0.015, -0.015), "north [m]", minimum=-1, maximum=1)

    def __post_init__(self) -> None:
        for name in ("yaw_deg", "altitude_m", "pitch_deg", "roll_deg", "x_m", "y_m"):
            steps = getattr(self, name)
            if not steps or steps[0] != 0.0:
                raise ValueError(f"{name} {list(steps)} found, expected a list that begins with 0: no change")


@dataclass(frozen=True, slots=True)
class DynamicOptions:
    """Method `dynamic`: trims of the trajectory, once per revolution of the scanner."""

    mode: str = option(
        ROBUST,
        "source: to the letter, a revolution against the one before; robust: with what is marked (robust) below",
        choices=(ROBUST, SOURCE),
    )
    start: str = option("ins", "method of the trajectory that is trimmed", choices=("ins", "filtered"))
    steps: StepOptions = option(StepOptions, "changes tried in a revolution")
    cut_m: float = option(
        0.7,
        "what is higher than this over the median height of a revolution is no ground [m]",
        minimum=0.01,
        maximum=100,
    )
    pixel_m: float = option(0.05, "pixel of the ground models [m]", minimum=0.02, maximum=1)
    fill_pixels: int = option(3, "widest gap that is filled by interpolation [pixels]", minimum=0, maximum=50)
    half_width_m: float = option(50.0, "ground models reach so far from the INS [m]", minimum=5, maximum=100)
    least_pixels: int = option(500, "with fewer to compare, nothing is changed", minimum=1)
    spline_hz: float = option(
        100.0, "the trims are interpolated to this rate by a spline [Hz]", minimum=1, maximum=1000
    )
    window_s: float = option(1.1, "(robust) the reference reaches so far back [s]", minimum=0.05, maximum=20)
    window_revolutions: int = option(
        5, "(robust) and is made of so many revolutions, evenly spaced", minimum=1, maximum=50
    )
    common: tuple[str, ...] = option(
        ("yaw", "pitch"), "(robust) a step of these turns the reference too: the error that they mend is in both"
    )
    baseline_m: float = option(
        1.0,
        "(robust) but not where the INS moved less than this over the reference [m]: nothing tells it",
        minimum=0,
        maximum=100,
    )
    loss_m: float = option(
        0.1, "(robust) height differences count as no larger than this [m]", minimum=0.01, maximum=1e3
    )
    plan_m: float = option(
        0.3,
        "(robust) what stands upright is compared in plan, distances count as no larger than this [m]; 0: it is not",
        minimum=0,
        maximum=2,
    )
    plan_pixel_m: float = option(0.1, "(robust) pixel of that [m]", minimum=0.02, maximum=1)
    plan_top_m: float = option(10.0, "(robust) up to so high over the ground [m]", minimum=0.5, maximum=100)
    least_gain: float = option(
        0.002, "(robust) a step must make the mean square smaller by this share", minimum=0, maximum=0.5
    )
    decay_s: float = option(
        10.0,
        "(robust) trims but yaw return to zero with this time constant [s]; 0: they do not",
        minimum=0,
        maximum=1e4,
    )
    course_s: float = option(
        0.0,
        "(robust) the vehicle drives where it points: yaw is drawn to the course over ground with this time constant [s]; 0: it is not",
        minimum=0,
        maximum=1e4,
    )
    course_speed_m_s: float = option(
        2.0, "slower than this there is no course over ground [m/s]", minimum=0.1, maximum=100
    )

    def __post_init__(self) -> None:
        unknown = set(self.common) - {"yaw", "altitude", "pitch", "roll", "x", "y"}
        if unknown:
            raise ValueError(f"common {sorted(unknown)[0]!r} found, expected yaw, altitude, pitch, roll, x or y")

    @property
    def robust(self) -> bool:
        """Whether the mode is the robust one."""
        return self.mode == ROBUST

    def effective(self) -> "DynamicOptions":
        """With all that is robust switched off where the mode is the source's."""
        if self.robust:
            return self
        return replace(
            self, window_revolutions=1, common=(), loss_m=1e3, plan_m=0.0, least_gain=0.0, decay_s=0.0, course_s=0.0
        )
