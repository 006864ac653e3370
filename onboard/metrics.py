"""The status as a text file for Prometheus, in the form that node exporters read from a folder (text format 0.0.4). Pure."""

from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple

from onboard.health import Verdict
from onboard.lidarstate import State
from onboard.status import Status

_SPACES: Final = ("room", "low", "full")
_ESCAPES: Final = {"\\": "\\\\", '"': '\\"', "\n": "\\n"}

Sample = tuple[Mapping[str, str], float]
"""Labels and value."""


class Metric(NamedTuple):
    """A metric with its samples; one that nothing is known of has none, and is left out."""

    name: str
    about: str
    samples: Iterable[Sample]

    @property
    def kind(self) -> str:
        """Counters are told by their names, as Prometheus wants it."""
        return "counter" if self.name.endswith("_total") else "gauge"


def text(status: Status, verdict: Verdict, armed: bool | None) -> str:
    """The file."""
    lines: list[str] = []
    for metric in metrics(status, verdict, armed):
        samples = [f"swathd_{metric.name}{_labels(labels)} {float(value)!r}" for labels, value in metric.samples]
        if samples:
            head = [
                f"# HELP swathd_{metric.name} {metric.about}",
                f"# TYPE swathd_{metric.name} {metric.kind}",
            ]
            lines += [*head, *samples]
    return "\n".join(lines) + "\n"


def metrics(status: Status, verdict: Verdict, armed: bool | None) -> list[Metric]:
    """All of them, in the order of the file."""
    return [
        Metric("info", "Version and the segment that is written.", [_info(status)]),
        Metric("verdict", "0 good, 1 warning, 2 critical, as the exit code of swathd health.", _one(int(verdict.level))),
        Metric("findings", "Sentences of the verdict.", _one(len(verdict.findings))),
        Metric("armed", "Whether an autopilot is armed; left out where that is not known.", _one(armed)),
        Metric("uptime_seconds", "Since the daemon started.", _one(status.uptime_s)),
        Metric("clock_steps_total", "Times that the wall clock was set.", _one(status.clock_steps)),
        Metric("temperature_celsius", "Of the board.", _one(status.temperature_c)),
        *_lidar(status),
        *_links(status),
        *_recorder(status),
        Metric("clock_uncertainty_seconds", "Of a device's clock against log time.",
               [({"clock": name}, clock.uncertainty_ms * 1e-3) for name, clock in status.clocks.items()]),
        Metric("clock_skew_ratio", "How much faster than log time a device's clock runs.",
               [({"clock": name}, clock.skew_ppm * 1e-6) for name, clock in status.clocks.items()]),
    ]  # fmt: skip


def _lidar(status: Status) -> list[Metric]:
    lidar = status.lidar
    lost = [({"where": "kernel"}, lidar.kernel_drops), ({"where": "queue"}, lidar.queue_drops)]
    return [
        Metric("lidar_state", "1 for the state that the lidar is in.",
               [({"state": state.value}, state == lidar.state) for state in State]),
        Metric("lidar_packets_per_second", "Data packets in the last second.", _one(lidar.packets_s)),
        Metric("lidar_expected_packets_per_second", "At its return mode and field of view; 0: not known.",
               _one(lidar.expected_packets_s)),
        Metric("lidar_age_seconds", "Since the newest good data packet.", _one(lidar.age_s)),
        Metric("lidar_received_packets_total", "Data packets received.", _one(lidar.received)),
        Metric("lidar_kept_packets_total", "Data packets recorded.", _one(lidar.kept)),
        Metric("lidar_masked_packets_total", "Data packets wholly outside the field of view.", _one(lidar.masked_packets)),
        Metric("lidar_lost_packets_total", "Data packets lost, by where.", lost),
        Metric("lidar_rejected_packets_total", "Packets that are none of the lidar's data, by reason.",
               [({"reason": reason}, count) for reason, count in lidar.rejected.items()]),
        Metric("lidar_position_packets_per_second", "Position packets in the last second.", _one(lidar.position_packets_s)),
    ]  # fmt: skip


def _links(status: Status) -> list[Metric]:
    links = status.links.items()
    return [
        Metric("link_connected", "Whether a MAVLink link is open.", [({"link": n}, link.connected) for n, link in links]),
        Metric("link_age_seconds", "Since the newest frame of the autopilot.",
               [({"link": n}, link.age_s) for n, link in links if link.age_s is not None]),
        Metric("link_frames_per_second", "Frames in the last second.", [({"link": n}, link.frames_s) for n, link in links]),
        Metric("link_bad_bytes_total", "Bytes that belong to no good frame.", [({"link": n}, link.bad_bytes) for n, link in links]),
        Metric("link_unknown_frames_total", "Frames of messages outside the dialect.",
               [({"link": n}, link.unknown_frames) for n, link in links]),
        Metric("link_dropped_bytes_total", "Bytes lost because the disk was too slow or full.",
               [({"link": n}, link.dropped_bytes) for n, link in links]),
        Metric("link_message_hertz", "Rate of a message that was asked for.",
               [({"link": n, "message": m}, hz) for n, link in links for m, hz in link.achieved_hz.items()]),
    ]  # fmt: skip


def _recorder(status: Status) -> list[Metric]:
    recorder = status.recorder
    left = None if recorder.minutes_left is None else recorder.minutes_left * 60.0
    lost = [({"where": "backlog"}, recorder.refused), ({"where": "disk"}, recorder.lost_on_disk),
            ({"where": "space"}, recorder.refused_for_space)]  # fmt: skip
    return [
        Metric("recorder_segment_bytes", "Of the log that is written, on the disk.", _one(recorder.bytes_on_disk)),
        Metric("recorder_backlog_bytes", "What the disk has not taken yet.", _one(recorder.backlog_bytes)),
        Metric("recorder_sync_age_seconds", "Since the log was last forced on to the disk.", _one(recorder.sync_age_s)),
        Metric("recorder_slowest_sync_seconds", "Since the start.", _one(recorder.slowest_sync_ms * 1e-3)),
        Metric("recorder_free_bytes", "On the disk of the logs.", _one(recorder.free_bytes)),
        Metric("recorder_left_seconds", "Until the lidar is no longer recorded.", _one(left)),
        Metric("recorder_space", "1 for the state that space is in.",
               [({"state": space}, space == recorder.space) for space in _SPACES]),
        Metric("recorder_segments_total", "Logs opened since the start.", _one(recorder.segments)),
        Metric("recorder_abandoned_segments_total", "Logs that were deleted or moved while they were written.",
               _one(recorder.abandoned)),
        Metric("recorder_lost_messages_total", "Messages lost, by where.", lost),
    ]  # fmt: skip


def _info(status: Status) -> Sample:
    return {"version": status.version, "segment": status.recorder.segment}, 1


def _one(value: float | None) -> list[Sample]:
    return [] if value is None else [({}, value)]


def _labels(labels: Mapping[str, str]) -> str:
    written = (f'{name}="{"".join(_ESCAPES.get(sign, sign) for sign in value)}"' for name, value in labels.items())
    return f"{{{','.join(written)}}}" if labels else ""
