"""A verdict on a log or a flight: good, doubtful or bad, with the reasons, from the figures that are there anyway.

A rule looks at figures and gives its reasons; `LOG_RULES` judge what `swath info` found, `FLIGHT_RULES` what stands in quality.json.
Whatever says `warning` or `warnings` anywhere in the figures is a reason too, so that who finds something new need only write it there.
"""

import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Self

GOOD: Final = "good"
DOUBTFUL: Final = "doubtful"
BAD: Final = "bad"
GRADES: Final = (GOOD, DOUBTFUL, BAD)
"""From best to worst."""
EXIT_CODES: Final = {GOOD: 0, DOUBTFUL: 3, BAD: 1}

LOST_PACKETS: Final = 0.01
"""Share of the lidar's packets. A sound network loses none; a hundredth still leaves 99 points of 100 in every square metre."""
LOST_FRAMES: Final = 0.1
"""Share of the autopilot's messages. Attitudes come at 4 Hz or more and are bridged over a second: of 10,000 such bridges one breaks."""
WITHOUT_POSE: Final = 0.1
"""Share of the shots. Half a second at either end is usual, and of no flight longer than ten seconds this much."""
WITHOUT_FIX: Final = 0.05
"""Share of the receiver's reports after its first fix."""
GAP_S: Final = 1.0
"""Attitudes are bridged over so long; over a longer silence there is no pose."""
LEAST_S: Final = 2.0
"""Without so much in common no clock of one can be tied to the other's."""
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
NO_MOUNT: Final = "firmware_config/mount.yaml"
"""What a mount's source says where neither log nor user stated one."""
_FRAME_BYTES: Final = 36
"""Of a usual MAVLink message."""
_LINKS: Final = "/mavlink/"
_BOARD_LOGS: Final = "/dataflash/"
_OWN_LINK: Final = "/mavlink/ins"


@dataclass(frozen=True, slots=True)
class Reason:
    """One thing that is not as it should be.

    Attributes
    ----------
    grade : str
        What it makes of the whole: `DOUBTFUL` or `BAD`.
    about : str
        One word for programs, such as "truncated".
    text : str
        For people: what was found, what was expected, what helps.
    """

    grade: str
    about: str
    text: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """The worst of all reasons, and all of them."""

    reasons: tuple[Reason, ...] = ()

    @property
    def grade(self) -> str:
        """One of `GRADES`."""
        return max((reason.grade for reason in self.reasons), key=GRADES.index, default=GOOD)

    @property
    def exit_code(self) -> int:
        """Of the program that gives it."""
        return EXIT_CODES[self.grade]

    def line(self) -> str:
        """The one line that a person reads; the worst comes first."""
        ordered = sorted(self.reasons, key=lambda reason: -GRADES.index(reason.grade))
        return f"verdict: {self.grade}" + "".join(
            f"{': ' if i == 0 else '; '}{reason.text}" for i, reason in enumerate(ordered)
        )

    def to_mapping(self) -> dict[str, Any]:
        """For JSON: the grade, and the reasons beside it."""
        return {"verdict": self.grade, "verdict_reasons": [asdict(reason) for reason in self.reasons]}

    @classmethod
    def from_mapping(cls, tree: Mapping[str, Any]) -> Self:
        """What `to_mapping` gave."""
        return cls(tuple(Reason(**reason) for reason in tree["verdict_reasons"]))


Figures = Mapping[str, Any]
Rule = Callable[[Figures], Iterator[Reason]]


def judge(figures: Figures, rules: Sequence[Rule]) -> Verdict:
    """What the rules say, and every warning in the figures."""
    found = [reason for rule in rules for reason in rule(figures)]
    found += [Reason(DOUBTFUL, "warning", text) for text in warnings_in(figures)]
    return Verdict(tuple(dict.fromkeys(found)))


def judge_log(summary: Figures) -> Verdict:
    """On one log, from what `flight.summary` found."""
    return judge(summary, LOG_RULES)


def judge_flight(quality: Figures) -> Verdict:
    """On a processed flight, from what quality.json holds."""
    return judge(quality, FLIGHT_RULES)


def warnings_in(figures: Any) -> list[str]:
    """Every text under a key `warning` or `warnings`, however deep, each once."""
    found: list[str] = []
    if isinstance(figures, Mapping):
        for key, value in figures.items():
            if key in ("warning", "warnings"):
                found += [text for text in ([value] if isinstance(value, str) else value or ()) if text]
            else:
                found += warnings_in(value)
    elif isinstance(figures, list | tuple):
        found += [text for each in figures for text in warnings_in(each)]
    return list(dict.fromkeys(found))


def _share(part: float, whole: float) -> float:
    return part / whole if whole > 0 else 0.0


def _percent(share: float) -> str:
    return f"{share:.0%}" if share >= 0.1 else f"{share:.1%}"


# One log --------------------------------------------------------------------------------------------------------------


def damage_of(log: str, end: str | None, truncated: bool, lost_bytes: int, pieces: int) -> Iterator[Reason]:
    """What is missing of a log, and what mends it."""
    mends = f"`swath recover {shlex.quote(log)}` makes a whole log of the rest"
    torn = f", {lost_bytes:,} bytes of it cannot be read" if lost_bytes else ""
    if truncated:
        until = f"; what came after {end} is missing" if end else ""
        yield Reason(DOUBTFUL, "truncated", f"{log} is cut off{until}{torn}; {mends}")
    elif lost_bytes or pieces:
        yield Reason(DOUBTFUL, "damaged", f"{log} is damaged in {pieces} pieces{torn}; {mends}")


def _log_damage(summary: Figures) -> Iterator[Reason]:
    damage = summary["damage"]
    yield from damage_of(
        summary["file"], summary["end_utc"], summary["truncated"], damage["lost_bytes"], damage["bad_chunks"]
    )
    if summary["messages_damaged"]:
        yield Reason(DOUBTFUL, "messages", f"{summary['messages_damaged']:,} messages cannot be read")


def _log_lidar(summary: Figures) -> Iterator[Reason]:
    lidar = summary["lidar"]
    if lidar is None or not _has_lidar(summary):
        # a trajectory can be made of the autopilot alone
        grade = DOUBTFUL if _has_autopilot(summary) else BAD
        yield Reason(grade, "lidar", "no lidar packets in the log, so that there are no points")
        return
    yield from _lost_packets(lidar["lost_packets"], lidar["packets"], lidar["account"] or {})


def _lost_packets(missing: int, packets: int, account: Mapping[str, int]) -> Iterator[Reason]:
    """`missing`: packets that the stamps tell of; `account`: what the recorder says, where there was one."""
    lost = max(missing, account.get("kernel_drops", 0) + account.get("queue_drops", 0))
    share = _share(lost, lost + packets)
    if share > LOST_PACKETS:
        text = f"{lost:,} lidar packets lost, {_percent(share)} of them (under {LOST_PACKETS:.0%} is usual)"
        yield Reason(DOUBTFUL, "lost_packets", text)


def _has_lidar(summary: Figures) -> bool:
    lidar = summary["lidar"]
    return lidar is not None and bool(lidar["packets"] or (lidar["account"] or {}).get("received"))


def _has_autopilot(summary: Figures) -> bool:
    """Whether it was heard, or its own log is there."""
    link = summary["mavlink"].get("ins")
    return bool(link and link["frames"]) or any(name.startswith(_BOARD_LOGS) for name in summary.get("topics", {}))


def _log_autopilot(summary: Figures) -> Iterator[Reason]:
    link = summary["mavlink"].get("ins")
    if link is None or not link["frames"]:
        if _has_autopilot(summary):
            return
        # the lidar alone still gives points in its own frame
        yield Reason(
            DOUBTFUL if _has_lidar(summary) else BAD,
            "autopilot",
            "no messages of the autopilot (link ins), so that nothing tells where the lidar was; `swath decode` gives "
            "the points in its own frame",
        )
        return
    sent = sum(message["count"] for message in link["messages"])
    share = _share(link["lost_frames"], link["lost_frames"] + sent)
    if link["shared_ids"]:
        names = " and ".join(link["shared_ids"])
        yield Reason(
            DOUBTFUL,
            "shared_id",
            f"several vehicles share the MAVLink id {names}, so that nobody can tell what was lost",
        )
    elif share > LOST_FRAMES:
        yield Reason(DOUBTFUL, "lost_frames", f"{_percent(share)} of the autopilot's messages were lost on the way")
    yield from _unreadable(link["bad_bytes"], link["frames"])
    if link["gps_fix_type"] is not None and link["gps_fix_type"] < 3:
        yield Reason(BAD, "gnss", "the GNSS receiver never had a fix in three dimensions")
    yield from _outages(link.get("gps_after_first_fix"))


def _unreadable(bad_bytes: int, frames: int) -> Iterator[Reason]:
    share = _share(bad_bytes, bad_bytes + frames * _FRAME_BYTES)
    if share > LOST_FRAMES:
        yield Reason(DOUBTFUL, "bad_bytes", f"{_percent(share)} of the autopilot's bytes belong to no good message")


def _outages(fixes: Mapping[str, int] | None) -> Iterator[Reason]:
    """`fixes`: reports of the receiver since its first fix, and how many of them are without one."""
    share = _share(fixes["without"], fixes["reports"]) if fixes else 0.0
    if share > WITHOUT_FIX:
        yield Reason(DOUBTFUL, "gnss", f"the GNSS receiver lost its fix for {_percent(share)} of the time")


def _log_gaps(summary: Figures) -> Iterator[Reason]:
    """Silences of what a trajectory is made of; a link of another autopilot's does not count."""
    gaps = [gap for gap in summary["gaps"] if not gap["topic"].startswith(_LINKS) or gap["topic"] == _OWN_LINK]
    if gaps:
        longest = max(gaps, key=lambda gap: float(gap["duration_s"]))
        count = f"{len(gaps)} gaps" if len(gaps) > 1 else "a gap"
        yield Reason(
            DOUBTFUL,
            "gaps",
            f"{count} of more than {GAP_S:g} s, the longest {longest['duration_s']:.1f} s in {longest['topic']} from "
            f"{longest['from_utc']}",
        )


def _log_together(summary: Figures) -> Iterator[Reason]:
    both_s = summary["lidar_with_autopilot_s"]
    if both_s is not None and both_s < LEAST_S:
        why = ": are they of one flight?" if both_s == 0.0 else ""
        text = f"the log holds {both_s:.1f} s of lidar and autopilot together, expected {LEAST_S:g} s or more{why}"
        yield Reason(BAD, "together", text)


LOG_RULES: Final[tuple[Rule, ...]] = (_log_damage, _log_lidar, _log_autopilot, _log_together, _log_gaps)


# A processed flight ---------------------------------------------------------------------------------------------------


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
    yield from _unreadable(autopilot["bad_bytes"], autopilot["frames"])
    for leg in quality["legs"]:
        yield from _outages(leg.get("gps_after_first_fix"))


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
    plan_m, height_m = max(sigma_m[:2]), sigma_m[2]
    # a sigma that nobody stated is not a number, and no reason
    if not (plan_m > POSITION_M[0] or height_m > POSITION_M[1]):
        return None
    grade = BAD if hopeless and max(plan_m, height_m) > POSITION_HOPELESS_M else DOUBTFUL
    return Reason(
        grade,
        "position",
        f"positions are known to {what}{plan_m:.1f} m in plan and {height_m:.1f} m in height (one sigma), expected "
        f"{POSITION_M[0]:g} and {POSITION_M[1]:g} m or better",
    )


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
    outside = _share(lidar["packets_outside_every_leg"], lidar["packets"])
    without = 1.0 - (1.0 - outside) * (1.0 - _share(dropped["no_pose"], shots))
    if without > WITHOUT_POSE:
        yield Reason(DOUBTFUL, "no_pose", f"{_percent(without)} of the lidar's shots have no pose and are left out")
    yield from _lost_packets(lidar["lost_packets"], lidar["packets"], lidar["aboard"])


FLIGHT_RULES: Final[tuple[Rule, ...]] = (_inputs, _clocks, _autopilot, _trajectory, _mount, _points)
