"""A status in words: one line for the journal, some for the person who asks."""

from typing import Final

from onboard.health import Verdict
from onboard.status import ClockStatus, LidarStatus, LinkStatus, Status


def summary(status: Status) -> str:
    """One line for `systemctl status`."""
    lidar, recorder = status.lidar, status.recorder
    links = ", ".join(f"{name} {link.frames_s:.0f}/s" for name, link in status.links.items())
    return (
        f"{recorder.segment}: lidar {lidar.packets_s:.0f}/s, position {lidar.position_packets_s:.0f}/s, "
        f"MAVLink {links or 'none'}, lost {lidar.kernel_drops + lidar.queue_drops}, "
        f"{recorder.bytes_on_disk / 1e6:.0f} MB"
    )


_PPS: Final = {0: "not told", 1: "synchronising", 2: "locked", 3: "error"}
"""Firmware of 2012 leaves it 0 even when locked."""


def report(status: Status, verdict: Verdict) -> list[str]:
    """The lines of `swathd health`."""
    lines = [f"{verdict.level.name}: {summary(status)}", *(f"  {finding}" for finding in verdict.findings)]
    lines += _report_lidar(status.lidar)
    for name, link in status.links.items():
        lines += _report_link(name, link)
    for name, clock in status.clocks.items():
        lines.append(_report_clock(name, clock))
    temperature = "" if status.temperature_c is None else f", {status.temperature_c:.0f} deg C"
    lines.append(f"host      up {status.uptime_s:.0f} s, wall clock set {status.clock_steps} times{temperature}")
    recorder = status.recorder
    left = "" if recorder.minutes_left is None else f", {recorder.minutes_left:.0f} min left"
    lines.append(
        f"recorder  {recorder.segment}, {recorder.bytes_on_disk / 1e6:.1f} MB, last sync "
        f"{recorder.sync_age_s:.1f} s ago, slowest {recorder.slowest_sync_ms:.0f} ms, "
        f"{recorder.free_bytes / 1e9:.1f} GB free{left}"
    )
    if (downlink := status.downlink) is not None:
        lines.append(
            f"downlink  {downlink.sent_s:.0f} datagrams/s, {downlink.kbit_s:.0f} kbit/s to {downlink.address}, "
            f"{downlink.dropped} dropped, {downlink.unheard} refused there"
        )
    return lines


def _report_lidar(lidar: LidarStatus) -> list[str]:
    expected = f" of {lidar.expected_packets_s:.0f}" if lidar.expected_packets_s else ""
    idle = "" if lidar.recording else ", not recorded: not armed"
    setting = (
        f", {lidar.rpm:.0f} rpm, {lidar.return_mode}, {lidar.fov_start_deg:.0f} to {lidar.fov_end_deg:.0f} deg"
        if lidar.return_mode
        else ""
    )
    return [
        f"lidar     {lidar.state}, {lidar.packets_s:.0f}{expected} packets/s{setting}{idle}",
        (
            f"          {lidar.kept} kept, {lidar.masked_packets} masked, dropped {lidar.kernel_drops} by the kernel and "
            f"{lidar.queue_drops} by the queue, {sum(lidar.rejected.values())} refused"
        ),
        (
            f"          position {lidar.position_packets_s:.0f} packets/s, PPS {_PPS.get(lidar.pps, lidar.pps)}, "
            f"GPS sentence {lidar.nmea or 'none'}"
        ),
    ]


def _report_link(name: str, link: LinkStatus) -> list[str]:
    firmware = f", firmware {link.firmware}" if link.firmware else ""
    heard = f"autopilot {link.autopilot}, MAVLink {link.version}{firmware}" if link.autopilot else "no autopilot"
    armed = {None: "unknown", True: "armed", False: "disarmed"}[link.armed]
    lines = [
        (
            f"{name:9} {link.frames_s:.0f} frames/s, {heard}, {armed}, {link.bad_bytes} bad bytes, "
            f"{link.unknown_frames} unknown frames"
        )
    ]
    if link.achieved_hz:
        rates = ", ".join(f"{message} {hz:.1f} of {link.asked_hz[message]}" for message, hz in link.achieved_hz.items())
        lines.append(f"          Hz: {rates}")
    return lines


def _report_clock(name: str, clock: ClockStatus) -> str:
    utc = ""
    if clock.utc_minus_wall_s is not None:
        utc = f", UTC of {clock.utc_source} is {clock.utc_minus_wall_s:+.3f} s from the wall clock"
    return (
        f"clock     {name} by {clock.method}, within {clock.uncertainty_ms:.1f} ms, {clock.skew_ppm:+.1f} ppm, "
        f"{clock.samples} samples, {clock.restarts} restarts{utc}"
    )
