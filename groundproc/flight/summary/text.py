"""The figures of a log as text for a pilot."""

import json
from collections.abc import Iterator
from typing import Any, Final

from flightlog.words import clean

_LONGEST: Final = 300
"""Characters of a value: names of topics and attachments are the file's own words."""


def as_text(summary: dict[str, Any]) -> str:
    """Lines of text for what `summary.log.summarise` or `summary.recording.summarise_recording` gives."""
    if "dataflash" in summary:
        return "\n".join([_first_line(summary), *_section("dataflash", _dataflash(summary))])
    lines = [_first_line(summary)]
    lines += _section("log", _log(summary))
    if imported := list(_import(summary["session"])):
        lines += _section("made of", iter(imported))
    if summary["lidar"] is not None:
        lines += _section("lidar", _lidar(summary))
    if summary["position"] is not None:
        lines += _section("position packets", _position(summary["position"]))
    for link, mavlink in summary["mavlink"].items():
        lines += _section(f"mavlink {link}", _mavlink(mavlink))
    if summary["utc"]["claims"]:
        lines += _section("UTC at one instant", _utc(summary["utc"]))
    if summary["gap_count"]:
        lines += _section(f"gaps of more than a second: {summary['gap_count']}", _gaps(summary))
    return "\n".join(lines)


def _first_line(summary: dict[str, Any]) -> str:
    kind = f" {summary['kind']['what']} ({summary['kind']['remedy']})," if "kind" in summary else ""
    duration = f", {summary['duration_s']} s" if "duration_s" in summary else ""
    return f"{summary['file']}:{kind} {_size(summary['bytes'])}{duration}"


def _dataflash(summary: dict[str, Any]) -> Iterator[tuple[str, str]]:
    messages = summary["dataflash"]["messages"]
    yield "messages", f"{sum(messages.values())} of {_many(len(messages), 'kind')}"
    for name, count in messages.items():
        yield clean(name), f"{count:8d}"
    for note in summary["notes"]:
        yield "note", note


def _section(title: str, rows: Iterator[tuple[str, str]]) -> list[str]:
    return ["", clean(title), *(f"  {clean(name):<22}{clean(text, _LONGEST)}" for name, text in rows)]


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e5 else f"{count} bytes"


def _many(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def _log(summary: dict[str, Any]) -> Iterator[tuple[str, str]]:
    topics = summary["topics"]
    if topics and all(name.startswith("/dataflash/") for name in topics):
        yield "recorded", "by the autopilot alone; its times are in its own messages"
    elif summary["start_utc"]:
        yield "recorded", f"{summary['start_utc']} to {summary['end_utc']} by the recording computer"
    for note in summary.get("notes", ()):
        yield "note", note
    if "kind" not in summary:
        yield from _made(summary)
    for name, topic in topics.items():
        rate = "" if topic["rate_hz"] is None else f", {topic['rate_hz']:.1f} a second"
        yield name, f"{_many(topic['messages'], 'message')}{rate}, {_size(topic['bytes'])}"
    for key, what in (
        ("messages_backwards", "messages are out of the order of time"),
        ("messages_damaged", "messages cannot be read"),
        ("host_clock_steps", "times was the recording computer's clock set"),
    ):
        if summary[key]:
            yield "", f"{summary[key]} {what}"


def _made(summary: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Who made a log, and how whole it is."""
    session = summary["session"]
    program = session.get("software") or (f"swath {session['version']}" if "version" in session else "")
    made = {"import": "imported", "simulate": "simulated"}.get(session.get("origin", ""), "recorded")
    yield "made by", f"{program or 'an unknown program'}, {made}"
    damage = summary["damage"]
    state = "cut off: the recorder did not finish it" if summary["truncated"] else "whole"
    if damage["bad_chunks"] or damage["lost_bytes"]:
        state += f"; {damage['bad_chunks']} damaged pieces, {damage['lost_bytes']} bytes lost"
    yield "state", state
    for place in damage["places"]:
        yield "", place
    if summary["attachments"]:
        yield "attached", ", ".join(summary["attachments"])


def _import(session: dict[str, str]) -> Iterator[tuple[str, str]]:
    """What an imported log was made of, and what was mended or left out."""
    try:
        sources, counters = (
            json.loads(session.get(name, empty)) for name, empty in (("sources", "[]"), ("counters", "{}"))
        )
        for source in sources:
            yield source["kind"], f"{clean(source['name'])}, {_size(source['bytes'])}"
        if senders := counters.get("senders"):
            yield "senders", ", ".join(f"{clean(name)} with {count}" for name, count in senders.items())
        disorder = sum(source["counters"].get("out_of_order", 0) for source in sources if source["kind"] != "tlog")
        mended = {
            "packets put in order": counters.get("reordered", 0) or disorder,
            "duplicates left out": counters.get("duplicates", 0),
            "MAVLink frames there twice": counters.get("mavlink_duplicates", 0),
        }
    except (ValueError, TypeError, KeyError, AttributeError):  # of another program
        return
    if any(mended.values()):
        yield "mended", ", ".join(f"{count} {what}" for what, count in mended.items() if count)


def _lidar(summary: dict[str, Any]) -> Iterator[tuple[str, str]]:
    lidar = summary["lidar"]
    yield "model", lidar["model"]
    yield "packets", f"{lidar['packets']}, {lidar['shots_with_return']} shots with a return"
    yield "return mode", str(lidar["return_mode"] or "unknown")
    if lidar["rpm"] is not None:
        yield "rotation", f"{lidar['rpm']:.1f} rpm (spread {lidar['rpm_spread']:.1f}), {lidar['turns']:.1f} turns"
    yield "azimuths seen", f"{lidar['azimuth_coverage_deg']} deg of 360"
    if lidar["window_aboard_deg"]:
        yield "window aboard", "{:.1f} to {:.1f} deg, clockwise".format(*lidar["window_aboard_deg"])
    if lidar["sensor_fov_deg"]:
        yield "the sensor's own", "{:.1f} to {:.1f} deg, clockwise".format(*lidar["sensor_fov_deg"])
    disorder = [
        f"{lidar[key]} {what}"
        for key, what in (("out_of_order", "out of order"), ("duplicates", "there twice"))
        if lidar[key]
    ]
    yield "lost packets", ", ".join([str(lidar["lost_packets"]), *disorder])
    aboard, sensor = lidar["missing_outside_window_aboard"], lidar["missing_outside_sensor_fov"]
    yield "not wanted", f"{aboard} outside the window aboard, {sensor} outside the sensor's own"
    account = lidar["account"] or {}
    counted = {name: account[name] for name in account if account[name] and name not in ("received", "kept")}
    if counted:
        yield "counted aboard", ", ".join(f"{name} {count}" for name, count in counted.items())
    clock = lidar["clock"]
    if summary["position"] is None and "/velodyne_packets" in summary["topics"]:
        yield "gyros", "none: the log holds no position packets of the lidar (UDP port 8308)"
    if clock is not None:
        rate = f"{clock['drift_ppm']:+.2f} +- {clock['drift_sigma_ppm']:.2f} ppm against the recording computer's"
        yield "clock", f"{rate}, jitter {clock['jitter_us']:.0f} us, set {clock['jumps']} times"


def _position(position: dict[str, Any]) -> Iterator[tuple[str, str]]:
    rate = "" if position["rate_hz"] is None else f", {position['rate_hz']:.1f} a second"
    inertial = (
        f"{position['with_imu']} with inertial readings"
        if position["with_imu"]
        else "none with inertial readings: no gyros"
    )
    yield "packets", f"{position['packets']}{rate}, {inertial}"
    yield "pulse (PPS)", ", ".join(f"{name} in {count}" for name, count in position["pps"].items()) or "unknown"
    gps = position["gps"]
    yield "GPS sentences", f"{gps['sentences']}, {gps['valid']} with a fix, {gps['unreadable']} unreadable"
    if gps["first_fix"]:
        fix = gps["first_fix"]
        yield "first fix", f"{fix['utc']} at {fix['latitude_deg']}, {fix['longitude_deg']}"
    lag = "" if gps["lag_s"] is None else f" (a sentence appears {gps['lag_s']} s after its second began)"
    yield "lidar clock", position["clock_state"] + lag


def _not_as_sent(mavlink: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """What of the telemetry came twice, late or damaged."""
    for key, what in (("duplicate_frames", "there twice"), ("late_frames", "out of order")):
        if mavlink[key]:
            yield "", f"{mavlink[key]} {what}"
    yield "bad bytes", str(mavlink["bad_bytes"])
    if mavlink["impossible"]:
        counts = ", ".join(f"{count} {name}" for name, count in mavlink["impossible"].items())
        yield "left out", f"{counts}: values that cannot be"


def _mavlink(mavlink: dict[str, Any]) -> Iterator[tuple[str, str]]:
    yield "frames", f"{mavlink['frames']}, {mavlink['unknown_frames']} of unknown kind"
    yield from _not_as_sent(mavlink)
    for autopilot in mavlink["autopilots"]:
        name = f"autopilot {autopilot['system']}/{autopilot['component']}"
        yield name, f"{_many(len(autopilot['boots']), 'boot')}, {autopilot['lost_frames']} frames lost on the way"
        for boot in autopilot["boots"]:
            since = f"{boot['from_boot_s']:.1f} to {boot['to_boot_s']:.1f} s since boot"
            yield "", f"{boot['from_utc']} to {boot['to_utc']}: {since}"
    for note in mavlink["notes"]:
        yield "note", note
    if mavlink["gps_fix_type"] is not None:
        yield "GPS", f"best fix type {mavlink['gps_fix_type']}, {mavlink['gps_satellites']} satellites at most"
    if mavlink["first_system_time_utc"]:
        yield "autopilot's UTC", f"stated, first {mavlink['first_system_time_utc']}"
    if mavlink["impossible_system_times"]:
        yield "", f"{mavlink['impossible_system_times']} messages state a date that cannot be; not used"
    for kind in mavlink["messages"]:
        rate = "" if kind["rate_hz"] is None else f"{kind['rate_hz']:8.2f} a second"
        yield f"{kind['system']}/{kind['component']} {kind['name']}".ljust(38), f"{kind['count']:8d} {rate}"


def _utc(utc: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for name, stated in utc["claims"].items():
        yield name, f"{stated}, mended to {right}" if (right := utc["right"].get(name, stated)) != stated else stated
    for sentence in (*utc["mended"], *utc["doubts"]):
        yield "", sentence


def _gaps(summary: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for gap in summary["gaps"]:
        yield gap["topic"], f"{gap['duration_s']:.1f} s from {gap['from_utc']}"
    if summary["gap_count"] > len(summary["gaps"]):
        yield "", "and more"
