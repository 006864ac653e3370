"""What a flight's figures say, in sentences and short tables."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from groundproc.reporting.delays import delays
from groundproc.reporting.markup import Html, section, table, tag
from groundproc.verdict import BAD, DOUBTFUL, GOOD, Verdict, warnings_in

Quality = Mapping[str, Any]
Row = Sequence[str]

_VERDICTS: Final = {
    GOOD: ("Good", "Nothing was found that speaks against using these products."),
    DOUBTFUL: ("Doubtful", "The products are complete, but something is missing or not as good as expected:"),
    BAD: ("Bad", "These products are not to be used as they are:"),
}
_SHOTS: Final = {
    "no_pose": "no pose at their time",
    "outside_fov": "outside the field of view that was chosen",
    "no_return": "no echo",
    "out_of_range": "nearer or farther than was chosen",
    "impossible": "a place that cannot be",
}
_ABOARD: Final = {
    "masked_packets": "lidar packets left out aboard by the mask",
    "masked_blocks": "lidar blocks left out aboard by the mask",
    "kernel_drops": "lidar packets lost in the recorder's kernel",
    "queue_drops": "lidar packets lost in the recorder's queue",
    "rejected": "datagrams that were no lidar packets",
}


def count(number: float) -> str:
    """A whole number for people."""
    return f"{number:,.0f}"


def length(metres: float) -> str:
    """With as many digits as tell something."""
    if not math.isfinite(metres):
        return "not known"
    return f"{metres:.3f} m" if abs(metres) < 0.1 else f"{metres:.2f} m"


def verdict(quality: Quality) -> Html:
    """The verdict, its reasons, and what else people ought to know."""
    found = Verdict.from_mapping(quality)
    word, sentence = _VERDICTS[found.grade]
    reasons = [tag("li", reason.text) for reason in sorted(found.reasons, key=lambda each: each.grade != BAD)]
    told = {reason.text for reason in found.reasons}
    notes = [text for text in (*_notes(quality), *warnings_in(quality)) if text not in told]
    return tag(
        "div",
        tag("p", tag("b", word), " ", sentence, class_="verdict-line"),
        tag("ul", reasons) if reasons else "",
        tag("ul", [tag("li", note) for note in dict.fromkeys(notes)], class_="notes") if notes else "",
        class_=f"verdict {found.grade}",
    )


def _notes(quality: Quality) -> Iterator[str]:
    yield from (note for note in quality["autopilot"]["notes"] if note)
    for leg in quality["legs"]:
        yield from (f"UTC: {said}" for said in leg["utc"]["mended"])
        if leg["positions"] and leg["positions"]["note"]:
            yield leg["positions"]["note"]
    for note in (quality["trajectory"]["note"], quality["sync"]["note"]):
        if note:
            yield note


def facts(quality: Quality, density: float | None, area_m2: float | None) -> Html:
    """The figures that people ask for first."""
    track, sync = quality["trajectory"], quality["sync"]
    east, north, up = track["median_sigma_m"]
    *level, heading = track.get(
        "median_sigma_attitude_deg", (math.nan,) * 3
    )  # figures made by an older swath have none
    rows = [
        ("Points", count(quality["points"]["written"])),
        ("Flown", f"{track['covered_s']:.0f} s"),
        ("Area", "" if area_m2 is None else f"{area_m2 / 1e4:.2f} ha" if area_m2 >= 1e4 else f"{count(area_m2)} m²"),
        ("Density, median", "" if density is None else f"{count(density)} /m²"),
        ("Position in plan, one sigma", length(math.hypot(east, north))),
        ("Height, one sigma", length(up)),
        ("Level, one sigma", f"{max(level):.2f}°" if all(map(math.isfinite, level)) else ""),
        ("Heading, one sigma", f"{heading:.2f}°" if math.isfinite(heading) else ""),
        ("Clocks, one sigma", f"{sync['sigma_s'] * 1e3:.2f} ms"),
    ]
    return tag("dl", [tag("div", tag("dt", name), tag("dd", value)) for name, value in rows if value], class_="facts")


def story(quality: Quality) -> Html:
    """How it was made, in a few sentences."""
    track, sync, mount = quality["trajectory"], quality["sync"], quality["mount"]
    crs, height = quality["crs"], quality["height"]
    code = f" (EPSG:{crs['epsg']})" if crs["epsg"] else ""
    sentences = [
        f"Recorded from {track['start']} to {track['end']} by lidar {quality['lidar']['model']}.",
        f"Coordinates are in {crs['name']}{code}, heights {height['meaning']}.",
        f"The trajectory is that of method {track['method']}; its sigmas are the {track['sigma_source']}."
        if track["sigma_source"] else f"The trajectory is that of method {track['method']}.",
        f"Lidar and autopilot were tied by {sync['method']} to {sync['sigma_s'] * 1e3:.2f} ms (one sigma).",
        f"The mount is {mount['source']}." if mount["source"].startswith("estimated") else f"The mount is from {mount['source']}.",
    ]  # fmt: skip
    return tag("p", " ".join(sentences), class_="story")


def losses(quality: Quality) -> Html:
    """Everything that was dropped or could not be read, by name; what is zero is said too."""
    points, lidar, pilot = quality["points"], quality["lidar"], quality["autopilot"]
    dropped = points["shots_dropped"]
    left_out = points.get("left_out", {})
    shots = points["written"] + sum(dropped.values()) + sum(left_out.values())
    rows: list[Row] = [
        (f"Shots with {_SHOTS.get(name, name)}", count(number), _of(number, shots)) for name, number in dropped.items()
    ]
    rows += [
        (f"Points left out by choice: {name}", count(number), _of(number, shots)) for name, number in left_out.items()
    ]
    packets = lidar["packets"]
    outside = lidar["packets_outside_every_leg"]
    rows.append(("Lidar packets at times without autopilot", count(outside), _of(outside, packets)))
    rows += [
        (_ABOARD.get(name, name).capitalize(), count(number), _of(number, packets + number))
        for name, number in lidar["aboard"].items()
    ]
    rows.append(("Bytes of the autopilot that belong to no good message", count(pilot["bad_bytes"]), ""))
    rows.append(("Bytes of board logs that cannot be read", count(pilot["board_log_bad_bytes"]), ""))
    rows += [(f"Impossible values of {name}", count(number), "") for name, number in pilot["impossible"].items()]
    for leg in quality["legs"]:
        if leg["positions"] and leg["positions"]["left_out"]:
            rows.append(("Positions left out", count(_total(leg["positions"]["left_out"])), ""))
        fixes = leg.get("gps_after_first_fix")
        if fixes:
            rows.append(
                (
                    "Reports of the GNSS receiver without a fix",
                    count(fixes["without"]),
                    _of(fixes["without"], fixes["reports"]),
                )
            )
    gaps, covered = quality["trajectory"]["gaps_s"], quality["trajectory"]["covered_s"]
    rows.append(("Seconds without a pose between first and last", f"{gaps:.1f}", _of(gaps, gaps + covered)))
    return section("losses", "Losses", table(("What", "How many", "Share"), rows, "numbers"))


def _total(left_out: Any) -> float:
    return float(sum(left_out.values())) if isinstance(left_out, Mapping) else float(left_out)


def _of(part: float, whole: float) -> str:
    share = part / whole if whole else 0.0
    if not share:
        return ""
    return f"{share:.1%}" if share >= 0.001 else "< 0.1%"


def clocks(quality: Quality) -> Html:
    """How lidar and autopilot were tied, leg by leg."""
    rows = []
    for number, leg in enumerate(quality["legs"], 1):
        sync = leg["sync"]
        rows.append(
            (
                f"Leg {number}", sync["method"], f"{sync['offset_s']:+.6f} s", f"{sync['sigma_s'] * 1e3:.2f} ms",
                f"{sync['drift_ppm']:+.1f} ± {sync['sigma_drift_ppm']:.1f} ppm", f"{sync['correlation_peak']:.3f}",
                f"{sync['rival_peak']:.3f}", f"{sync['residual_deg_s']:.2f} deg/s", count(sync["samples"]), leg["utc"]["source"],
            )
        )  # fmt: skip
    head = ("", "Tied by", "Offset", "Sigma", "Drift", "Peak", "Next peak", "Residual", "Samples", "UTC from")
    said = delays(quality)
    return section(
        "clocks", "Clocks", table(head, rows, "numbers"), *([tag("p", f"{said[0].upper()}{said[1:]}.")] if said else [])
    )


def control(quality: Quality) -> Html:
    """Surveyed points and how far the cloud is from them; empty where none were given."""
    found = quality.get(quality["trajectory"]["method"], {}).get("control")
    if not found:
        return Html("")
    rows = [
        (
            point["name"], point.get("use", ""), point["state"], _off(point.get("before_m")), _off(point.get("after_m")),
            _off(point.get("sigma_m")),
        )
        for point in found["points"]
    ]  # fmt: skip
    parts = [table(("Point", "Use", "State", "Off before", "Off after", "Expected, one sigma"), rows, "numbers")]
    for use, name in (("used", "Control points"), ("check", "Check points, not used")):
        told = found[use]
        if told["count"]:
            parts.append(
                tag(
                    "p",
                    f"{name}: {told['count']}, off by {_off(told['after_rms_m'])} RMS, {_off(told['sigma_m'])} expected.",
                )
            )
    parts += [tag("p", found["note"])] if found["note"] else []
    return section("control", "Control points", *parts)


def _off(value: float | None) -> str:
    return "–" if value is None else f"{value:+.3f} m".replace("-", "−")


def settings(tree: Mapping[str, Any]) -> Html:
    """Everything that was chosen, as names and values."""
    rows = [(name, _plain(value)) for name, value in _leaves(tree)]
    return section(
        "settings", "Settings", tag("details", tag("summary", f"{len(rows)} options"), table((), rows, "keys"))
    )


def _leaves(tree: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def _plain(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(_plain(each) for each in value) or "none"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def provenance(quality: Quality, digests: Mapping[str, str]) -> Html:
    """Versions, and hashes of what went in and came out."""
    software = quality["software"]
    rows = [
        (log["file"], f"{log['bytes']:,} bytes, {log['start']} to {log['end']}", digests.get(log["file"], ""))
        for log in quality["inputs"]
    ]
    inputs = {log["file"] for log in quality["inputs"]}
    made = [(name, digest) for name, digest in sorted(digests.items()) if name not in inputs]
    versions = f"swath {software['swath']}, flight log format {software['log_format']}"
    return section(
        "provenance", "Inputs and products", tag("p", f"Made with {versions}. Hashes are SHA-256."),
        table(("Input", "What", "Hash"), rows, "hashes"), table(("Product", "Hash"), made, "hashes"),
    )  # fmt: skip
