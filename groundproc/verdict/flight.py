"""The verdict on a processed flight, from what stands in quality.json."""

import math
from collections.abc import Iterator, Sequence
from typing import Final

from groundproc.verdict import BAD, DOUBTFUL, Figures, Reason, Rule, Verdict, judge, percent, share
from groundproc.verdict.log import GAP_S, damage_of, lost_packets, outages, unreadable

WITHOUT_POSE: Final = 0.1
"""Share of the shots. Half a second at either end is usual, and of no flight longer than ten seconds this much."""
BEAM_MRAD: Final = 2.8
"""Width of the HDL-32E's beam: what the error of the clocks' tie may put it off by in the turns of the flight."""
USUAL_TURN_DEG_S: Final = 30.0
"""Of a multirotor in a brisk survey, where the turns of the flight are not stated."""
SYNC_HOPELESS_S: Final = 0.5
"""Half of the time in which a multirotor's attitude changes: a pose belongs to another manoeuvre than its shots."""
POSITION_M: Final = (10.0, 15.0)
"""In plan, each axis, and in height: a receiver of 2.5 m at a dilution of precision of 4, beyond which it counts as poor."""
POSITION_HOPELESS_M: Final = 50.0
"""As far as the lidar sees the ground from the usual height: the cloud shows another place than it says."""
LEVEL_DEG: Final = 2.0
"""One sigma of roll and pitch: a poor autopilot's. 30 m away, a usual range, a point then lies 1 m beside its place."""
HEADING_DEG: Final = 10.0
"""One sigma: a poor compass's; a point 30 m away then lies 5 m beside its place."""
USUAL_RANGE_M: Final = 30.0
NO_MOUNT: Final = "firmware_config/mount.yaml"
"""What a mount's source says where neither log nor user stated one."""


def _inputs(quality: Figures) -> Iterator[Reason]:
    for log in quality["inputs"]:
        yield from damage_of(log["file"], log["end"], log["truncated"], log["lost_bytes"], log["bad_chunks"])


def _clocks(quality: Figures) -> Iterator[Reason]:
    worst = max((leg["sync"] for leg in quality["legs"]), key=lambda sync: float(sync["sigma_s"]), default=None)
    if worst is None:
        return
    sigma_s = worst["sigma_s"]
    rate_deg_s = quality["trajectory"].get("turn_rate_deg_s", USUAL_TURN_DEG_S)
    off_mrad = sigma_s * math.radians(rate_deg_s) * 1e3
    if off_mrad > BEAM_MRAD or sigma_s > SYNC_HOPELESS_S:
        why = f" ({worst['note']})" if worst["note"] else ""
        yield Reason(
            BAD if sigma_s > SYNC_HOPELESS_S else DOUBTFUL,
            "sync",
            f"lidar and autopilot are tied by {worst['method']} to {sigma_s * 1e3:,.0f} ms only, by which turns of "
            f"{rate_deg_s:.0f} deg/s put the beam {off_mrad:.1f} mrad off, expected {BEAM_MRAD:g} or less{why}",
        )
    if any(leg["utc"]["source"] == "host" for leg in quality["legs"]):
        yield Reason(DOUBTFUL, "utc", "no GNSS time in the log: UTC is what the recording computer's clock said")


def _autopilot(quality: Figures) -> Iterator[Reason]:
    autopilot = quality["autopilot"]
    yield from unreadable(autopilot["bad_bytes"], autopilot["frames"])
    for leg in quality["legs"]:
        yield from outages(leg.get("gps_after_first_fix"))


def _trajectory(quality: Figures) -> Iterator[Reason]:
    track = quality["trajectory"]
    if track["gaps_s"] > GAP_S:
        whole_s = track["gaps_s"] + track["covered_s"]
        yield Reason(DOUBTFUL, "gaps", f"no pose for {track['gaps_s']:.1f} s of {whole_s:.1f} s between first and last")
    for name, what in (("median_sigma_m", ""), ("largest_sigma_m", "at worst ")):
        found = track.get(name)
        reason = _position(found, what, name == "median_sigma_m") if found else None
        if reason is not None:
            yield reason
            return


def _position(sigma_m: Sequence[float], what: str, hopeless: bool) -> Reason | None:
    """What a sigma of east, north and up says of the positions."""
    east_m, north_m, height_m = _stated(sigma_m)
    plan_m = max(east_m, north_m)
    if plan_m <= POSITION_M[0] and height_m <= POSITION_M[1]:
        return None
    grade = BAD if hopeless and max(plan_m, height_m) > POSITION_HOPELESS_M else DOUBTFUL
    return Reason(
        grade,
        "position",
        f"positions are known to {what}{plan_m:.1f} m in plan and {height_m:.1f} m in height (one sigma), expected "
        f"{POSITION_M[0]:g} and {POSITION_M[1]:g} m or better",
    )


def _stated(sigmas: Sequence[float]) -> list[float]:
    """A sigma that nobody stated is not a number, and no reason: 0 takes its place."""
    return [0.0 if math.isnan(sigma) else sigma for sigma in sigmas]


def _attitude(quality: Figures) -> Iterator[Reason]:
    found = quality["trajectory"].get("median_sigma_attitude_deg")
    if not found:
        return
    roll_deg, pitch_deg, heading_deg = _stated(found)
    level_deg = max(roll_deg, pitch_deg)
    if level_deg > LEVEL_DEG or heading_deg > HEADING_DEG:
        off_m = USUAL_RANGE_M * math.radians(max(level_deg, heading_deg))
        known = {"level": level_deg, "heading": heading_deg}
        said = " and ".join(f"{name} to {value:.1f} deg" for name, value in known.items() if value)
        yield Reason(
            DOUBTFUL,
            "attitude",
            f"the lidar's attitude is known in {said} only (one sigma), which moves points {USUAL_RANGE_M:.0f} m away by up "
            f"to {off_m:.1f} m, expected {LEVEL_DEG:g} and {HEADING_DEG:g} deg or better{_remedy(quality)}",
        )


def _remedy(quality: Figures) -> str:
    """What would know the attitude better."""
    measured = quality["trajectory"]["method"] == "adjusted" and not quality["config"]["causal"]
    return "" if measured else "; the adjustment over the whole flight (`--method adjusted`) measures them"


def _mount(quality: Figures) -> Iterator[Reason]:
    source = quality["mount"]["source"]
    if source == NO_MOUNT or source.endswith(f"begun from {NO_MOUNT}"):
        yield Reason(
            DOUBTFUL,
            "mount",
            "neither log nor survey says how the lidar is mounted: that of the project's own airframe was taken; give "
            "yours with --mount FILE",
        )


def _points(quality: Figures) -> Iterator[Reason]:
    points, lidar = quality["points"], quality["lidar"]
    if not points["written"]:
        yield Reason(BAD, "points", "not one point was written")
    dropped = points["shots_dropped"]
    shots = points["written"] + sum(dropped.values()) + sum(points.get("left_out", {}).values())
    outside = share(lidar["packets_outside_every_leg"], lidar["packets"])
    without = 1.0 - (1.0 - outside) * (1.0 - share(dropped["no_pose"], shots))
    if without > WITHOUT_POSE:
        yield Reason(DOUBTFUL, "no_pose", f"{percent(without)} of the lidar's shots have no pose and are left out")
    yield from lost_packets(lidar["lost_packets"], lidar["packets"], lidar["aboard"])


FLIGHT_RULES: Final[tuple[Rule, ...]] = (_inputs, _clocks, _autopilot, _trajectory, _attitude, _mount, _points)


def judge_flight(quality: Figures) -> Verdict:
    """On a processed flight, from what quality.json holds."""
    return judge(quality, FLIGHT_RULES)
