"""quality.json: what went in, what was dropped and why, how well the clocks fit."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from flightlog import FORMAT_VERSION, __version__, config
from flightlog.clock import utc_text
from flightlog.constants import HOUR_NS
from flightlog.logfile import LogReader
from groundproc import geodesy
from groundproc.cloud.placing import Tally
from groundproc.estimation import ins
from groundproc.estimation.method import Estimate
from groundproc.flight.flight import Flight
from groundproc.flight.timeline import Leg
from groundproc.survey import Survey


def describe(
    readers: Sequence[LogReader],
    survey: Survey,
    made: Estimate,
    mount_source: str,
    flight: Flight,
    timeline: Sequence[Leg],
    projection: geodesy.Projection,
    tally: Tally,
) -> dict[str, Any]:
    """What went in, what was dropped and why, and how well the clocks fit."""
    frame, trajectory = projection.frame, made.trajectory
    main = max(timeline, key=lambda leg: leg.sync.samples)
    seconds = np.diff(trajectory.time_ns) * 1e-9
    return {
        "software": {"swath": __version__, "log_format": FORMAT_VERSION},
        "inputs": [describe_log(reader) for reader in readers],
        "config": config.to_mapping(survey),
        "mount": config.to_mapping(made.mount) | {"source": mount_source},
        "local_frame": {
            "latitude_deg": frame.latitude_deg,
            "longitude_deg": frame.longitude_deg,
            "height_m": frame.height_m,
        },
        "crs": {"epsg": projection.crs.to_epsg(), "name": projection.crs.name},
        "height": {"reference": survey.height, "meaning": ins.HEIGHTS[survey.height]},
        "sync": describe_sync(main),
        "legs": [describe_leg(leg) for leg in timeline],
        "autopilot": {
            "system": main.boot.system,
            "component": main.boot.component,
            "boots": len(flight.boots),
            "frames": flight.frames,
            "bad_bytes": flight.bad_bytes,
            "unknown_frames": flight.unknown,
        },
        "trajectory": {
            "method": made.method,
            "start": utc_text(int(trajectory.time_ns[0])),
            "end": utc_text(int(trajectory.time_ns[-1])),
            "knots": len(trajectory),
            "covered_s": float(seconds[trajectory.covered[:-1]].sum()),
            "gaps_s": float(seconds[~trajectory.covered[:-1]].sum()),
            "median_sigma_m": np.median(trajectory.sigma_position_m, axis=0).tolist(),
            "sigma_source": made.sigma_source,
            "note": made.note,
            "warning": made.warning,
        },
        **({made.method: made.report} if made.report else {}),
        "lidar": {
            "model": flight.lidar.name,
            "packets": tally.packets,
            "packets_outside_every_leg": tally.packets_without_leg,
            "aboard": {
                "masked_packets": tally.masked_packets,
                "masked_blocks": tally.masked_blocks,
                "kernel_drops": tally.kernel_drops,
                "queue_drops": tally.queue_drops,
                "rejected": tally.rejected,
            },
        },
        "points": {
            "written": tally.written,
            "range_step_m": flight.lidar.range_step_m,
            "shots_dropped": asdict(tally.dropped),
        },
    }


def describe_log(reader: LogReader) -> dict[str, Any]:
    """One input of quality.json."""
    return {
        "file": reader.path.name,
        "bytes": reader.size,
        "start": utc_text(reader.start_ns),
        "end": utc_text(reader.end_ns),
        "truncated": reader.damage.truncated,
        "bad_chunks": reader.damage.bad_chunks,
        "lost_bytes": reader.damage.lost_bytes,
    }


def describe_leg(leg: Leg) -> dict[str, Any]:
    """One leg of quality.json."""
    return {
        "boot": leg.boot.number,
        "lidar_run": leg.run,
        "attitude_from": ins.attitude_source(leg.boot),
        "position_from": ins.position_source(leg.boot),
        "utc": {"source": leg.utc.source, "sigma_s": leg.utc.sigma_ns * 1e-9},
        "sync": describe_sync(leg),
    }


def describe_sync(leg: Leg) -> dict[str, Any]:
    """One synchronisation of quality.json: boot time = lidar time past the hour + offset, both as stamped, at `at_lidar_s`."""
    found = leg.sync
    # to the lidar's stamps as sent: the hours that carry them on to a date are ours
    hours_ns = found.reference_ns // HOUR_NS * HOUR_NS
    return {
        "method": found.method,
        "offset_s": (found.offset_ns + hours_ns) * 1e-9,
        "sigma_s": found.sigma_offset_ns * 1e-9,
        "at_lidar_s": (found.reference_ns - hours_ns) * 1e-9,
        "drift_ppm": found.drift_ppm,
        "sigma_drift_ppm": found.sigma_drift_ppm,
        "correlation_peak": found.peak,
        "rival_peak": found.rival,
        "residual_deg_s": float(np.rad2deg(found.residual_rad_s)),
        "samples": found.samples,
        "mount_angle_deg": found.mount_angle_deg,
        "note": found.note,
    }
