"""The verdict on one log, from what `swath info` found."""

import shlex
from collections.abc import Iterator, Mapping
from typing import Final

from groundproc.verdict import BAD, DOUBTFUL, Figures, Reason, Rule, Verdict, judge, percent, share

LOST_PACKETS: Final = 0.01
"""Share of the lidar's packets. A sound network loses none; a hundredth still leaves 99 points of 100 in every square metre."""
LOST_FRAMES: Final = 0.1
"""Share of the autopilot's messages. Attitudes come at 4 Hz or more and are bridged over a second: of 10,000 such bridges one breaks."""
WITHOUT_FIX: Final = 0.05
"""Share of the receiver's reports after its first fix."""
GAP_S: Final = 1.0
"""Attitudes are bridged over so long; over a longer silence there is no pose."""
LEAST_S: Final = 2.0
"""Without so much in common no clock of one can be tied to the other's."""
_FRAME_BYTES: Final = 36
"""Of a usual MAVLink message."""
_LINKS: Final = "/mavlink/"
_BOARD_LOGS: Final = "/dataflash/"
_OWN_LINK: Final = "/mavlink/ins"


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
    yield from lost_packets(lidar["lost_packets"], lidar["packets"], lidar["account"] or {})


def lost_packets(missing: int, packets: int, account: Mapping[str, int]) -> Iterator[Reason]:
    """`missing`: packets that the stamps tell of; `account`: what the recorder says, where there was one."""
    lost = max(missing, account.get("kernel_drops", 0) + account.get("queue_drops", 0))
    part = share(lost, lost + packets)
    if part > LOST_PACKETS:
        text = f"{lost:,} lidar packets lost, {percent(part)} of them (under {LOST_PACKETS:.0%} is usual)"
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
    part = share(link["lost_frames"], link["lost_frames"] + sent)
    if link["shared_ids"]:
        names = " and ".join(link["shared_ids"])
        yield Reason(
            DOUBTFUL,
            "shared_id",
            f"several vehicles share the MAVLink id {names}, so that nobody can tell what was lost",
        )
    elif part > LOST_FRAMES:
        yield Reason(DOUBTFUL, "lost_frames", f"{percent(part)} of the autopilot's messages were lost on the way")
    yield from unreadable(link["bad_bytes"], link["frames"])
    if link["gps_fix_type"] is not None and link["gps_fix_type"] < 3:
        yield Reason(BAD, "gnss", "the GNSS receiver never had a fix in three dimensions")
    yield from outages(link.get("gps_after_first_fix"))


def unreadable(bad_bytes: int, frames: int) -> Iterator[Reason]:
    """Bytes of a link in no message that can be verified."""
    part = share(bad_bytes, bad_bytes + frames * _FRAME_BYTES)
    if part > LOST_FRAMES:
        yield Reason(DOUBTFUL, "bad_bytes", f"{percent(part)} of the autopilot's bytes belong to no good message")


def outages(fixes: Mapping[str, int] | None) -> Iterator[Reason]:
    """`fixes`: reports of the receiver since its first fix, and how many of them are without one."""
    part = share(fixes["without"], fixes["reports"]) if fixes else 0.0
    if part > WITHOUT_FIX:
        yield Reason(DOUBTFUL, "gnss", f"the GNSS receiver lost its fix for {percent(part)} of the time")


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


def judge_log(summary: Figures) -> Verdict:
    """On one log, from what `flight.summary` found."""
    return judge(summary, LOG_RULES)
