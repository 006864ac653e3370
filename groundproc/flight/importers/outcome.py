"""What an import found, judged: refused where the lidar or its gyros were left behind, and said where anything else was."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any, Final

from flightlog.clock import utc_text
from flightlog.errors import CaptureError
from groundproc.flight.importers.autopilotlogs import Tlog
from groundproc.flight.importers.batching import Joiner
from groundproc.flight.importers.captures import Capture, snap_text
from groundproc.flight.importers.ports import Elsewhere, Ports
from groundproc.flight.importers.senders import listed, name_of
from groundproc.flight.importers.sources import Source

_NETWORKS: Final = ("capture", "bag")
"""Kinds of sources in which a lidar can be."""


def counters(joiner: Joiner, sources: Sequence[Source]) -> dict[str, Any]:
    """The figures of an import, as the log keeps them."""
    count = joiner.count
    late = sum(source.steady.out_of_order for source in sources if isinstance(source, Capture))
    return {
        "lidar": {name: value for name, value in asdict(count.lidar).items() if not name.startswith("fov")},
        "position_received": count.position_received,
        "position_rejected": count.position_rejected,
        "duplicates": count.duplicates,
        "reordered": count.reordered + late,
        "mavlink_duplicates": count.mavlink_duplicates,
        "senders": {name_of(sender): packets for sender, packets in count.senders.most_common()},
        "sender": name_of(joiner.sender) if joiner.sender else None,
    }


def check(joiner: Joiner, sources: Sequence[Source], ports: Ports) -> None:
    """Refuse an import that found nothing of use, or that leaves packets of the lidar on ports that were not asked for.

    Raises
    ------
    CaptureError
        With the likeliest reason and its remedy.
    """
    captures = [source for source in sources if isinstance(source, Capture)]
    names = ", ".join(str(source.path) for source in sources if source.kind in _NETWORKS)
    elsewhere = _elsewhere(captures)
    if hints := list(_port_hints(joiner, elsewhere, ports)):
        found, options, without = zip(*hints, strict=True)
        leave = f" (or {' '.join(without)} to leave them out)" if all(without) else ""
        raise CaptureError(f"{names}: {' and '.join(found)}: give {' '.join(options)}{leave}")
    if joiner.count.lidar.kept:
        return
    for capture in captures:
        if capture.datagrams.cut:
            raise CaptureError(f"{capture.path}: {snap_text(capture.datagrams)}")
    position = joiner.count.position_received - joiner.count.position_rejected
    if position or _has_telemetry(joiner, sources):
        return
    raise CaptureError(f"{names}: holds no packet of a lidar ({_why_none(joiner, captures, elsewhere)})")


def _has_telemetry(joiner: Joiner, sources: Sequence[Source]) -> bool:
    """Whether an import is one of an autopilot alone: no packet came to the lidar's ports, and captures and bags hold MAVLink."""
    if joiner.count.lidar.received or joiner.count.position_received:
        return False
    networks = [source for source in sources if source.kind in _NETWORKS]
    return any(source.mavlink_frames for source in networks) if networks else True


def _elsewhere(captures: Sequence[Capture]) -> Elsewhere:
    found = Elsewhere()
    for capture in captures:
        found.update(capture.elsewhere)
    return found


def _port_hints(joiner: Joiner, elsewhere: Elsewhere, ports: Ports) -> Iterator[tuple[str, str, str]]:
    """What went to another port than the one asked for, more of it than there; the option that takes it, and one that does not."""
    count = joiner.count
    kept = {"lidar": count.lidar.kept, "position": count.position_received - count.position_rejected}
    for name, others, what in (
        ("lidar", elsewhere.data, "data packets of a lidar"),
        ("position", elsewhere.position, "position packets (gyros, GPS)"),
    ):
        port, packets = _most(others)
        needed = name == "lidar" and not kept[name]
        if packets > kept[name] and (needed or name not in ports.given):
            asked = getattr(ports, name)
            without = "" if needed else f"--{name}-port {asked}"
            yield f"{packets} {what} went to UDP port {port}, {kept[name]} to {asked}", f"--{name}-port {port}", without


def _most(counts: Counter[int]) -> tuple[int, int]:
    return counts.most_common(1)[0] if counts else (0, 0)


def _why_none(joiner: Joiner, captures: Sequence[Capture], elsewhere: Elsewhere) -> str:
    lidar = joiner.count.lidar
    damage = "; ".join(f"it {capture.found.damage}" for capture in captures if capture.found.damage)
    if lidar.received:
        return f"{lidar.received} packets came to its port, none of them a {joiner.lidar.name}'s"
    port, datagrams = _most(elsewhere.mavlink)
    if datagrams:
        return f"but {datagrams} datagrams with MAVLink at UDP port {port}: --mavlink-port {port} takes them"
    return damage or f"{sum(c.found.packets for c in captures)} packets seen, none to the lidar's UDP port"


def notes(joiner: Joiner, sources: Sequence[Source], ports: Ports) -> list[str]:
    """Sentences on what was left out or mended."""
    captures = [source for source in sources if isinstance(source, Capture)]
    return [
        *_packet_notes(joiner, sources),
        *_mended(joiner),
        *_left_elsewhere(joiner, _elsewhere(captures), sources, ports),
        *_overlap_notes(sources),
    ]


def _packet_notes(joiner: Joiner, sources: Sequence[Source]) -> Iterator[str]:
    lidar = joiner.count.lidar
    if not lidar.kept and any(source.kind in _NETWORKS for source in sources):
        position = joiner.count.position_received > joiner.count.position_rejected
        yield "no lidar data packet was found" + (", position packets only" if position else "")
    if lidar.rejected_length:
        yield f"{lidar.rejected_length} packets of a wrong length on the lidar's port left out"
    if lidar.rejected_content:
        yield f"{lidar.rejected_content} packets that are no {joiner.lidar.name}'s on the lidar's port left out"
    if lidar.rejected_sender:
        yield f"{lidar.rejected_sender} packets of a second sender on the lidar's port left out"
    if len(joiner.count.senders) > 1:
        yield (
            f"senders of data packets: {listed(joiner.count.senders)}; {name_of(joiner.sender)} was taken, --sender takes "
            "another"
        )
    if joiner.count.position_rejected:
        yield f"{joiner.count.position_rejected} packets on the position port left out"


def _mended(joiner: Joiner) -> Iterator[str]:
    count = joiner.count
    if count.duplicates:
        yield f"{count.duplicates} packets of the lidar were there twice; each was taken once"
    if count.mavlink_duplicates:
        yield f"{count.mavlink_duplicates} MAVLink frames were there twice; each was taken once"
    if count.reordered:
        yield f"{count.reordered} packets of the lidar were out of order and put in their place"


def _left_elsewhere(joiner: Joiner, elsewhere: Elsewhere, sources: Sequence[Source], ports: Ports) -> Iterator[str]:
    for name, others, what in (
        ("lidar", elsewhere.data, "data packets"),
        ("position", elsewhere.position, "position packets"),
    ):
        for port, packets in others.most_common():
            instead = f"--{name}-port {port} takes them in place of {getattr(ports, name)}"
            yield f"{packets} {what} of a lidar to UDP port {port} left out; {instead}"
    if any(source.mavlink_frames for source in sources):
        return
    for port, datagrams in elsewhere.mavlink.most_common():
        yield f"{datagrams} datagrams with MAVLink at UDP port {port} left out; --mavlink-port {port} takes them"


def _overlap_notes(sources: Sequence[Source]) -> list[str]:
    """Say which telemetry was not recorded while the lidar was: two flights, or two computers' clocks."""
    captures = [s.steady for s in sources if isinstance(s, Capture) and s.steady.first_ns is not None]
    if not captures:
        return []
    start_ns = min(steady.first_ns or 0 for steady in captures)
    end_ns = max(steady.last_ns for steady in captures)
    return [
        f"{s.path}: lies wholly before or after the lidar packets ({utc_text(s.steady.first_ns)} to "
        f"{utc_text(s.steady.last_ns)}; these {utc_text(start_ns)} to {utc_text(end_ns)})"
        for s in sources
        if isinstance(s, Tlog) and s.steady.first_ns is not None
        if s.steady.last_ns < start_ns or s.steady.first_ns > end_ns
    ]
