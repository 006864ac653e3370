"""From flight logs to products: the stages in order, and nothing else.

log --load--> packets, frames --timeline--> one time scale --trajectory--> poses --georeference--> points --products--> files
"""

import contextlib
import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import FORMAT_VERSION, __version__, config
from flightlog.clock import utc_text
from flightlog.constants import HOUR_NS
from flightlog.errors import CoverageError, LogError, UsageError
from flightlog.hdl32e import RANGE_LSB_M
from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc import decode, geodesy, georeference, load, sensor_model
from groundproc.decode import Gate
from groundproc.files import made_folder, written_aside
from groundproc.flight import Flight, read_flight
from groundproc.georeference import Dropped, Points
from groundproc.mounting import find_mount
from groundproc.products import las
from groundproc.products.pictures import CloudSample, draw_cloud
from groundproc.survey import Survey
from groundproc.timeline import Leg, legs
from groundproc.trajectory import ins
from groundproc.trajectory.table import read_trajectory, write_trajectory
from groundproc.trajectory.trajectory import Trajectory, joined

CHUNK_PACKETS: Final = 1808
"""Packets placed at a time, a second's worth: bounds the memory, and is long enough for both cores to compress."""


Progress = Callable[[str, int], None]
"""Is told that so many more bytes of the logs are through a stage, "read" or "place"."""


@dataclass(slots=True)
class Tally:
    """What became of the lidar's packets."""

    packets: int = 0
    masked_packets: int = 0
    masked_blocks: int = 0
    kernel_drops: int = 0
    queue_drops: int = 0
    rejected: int = 0
    packets_without_leg: int = 0
    written: int = 0
    dropped: Dropped = field(default_factory=Dropped)


def process(
    logs: Sequence[Path], survey: Survey, folder: Path, progress: Progress, poses: Path | None = None
) -> dict[str, Any]:
    """Make cloud.laz, trajectory.csv, quality.json and pictures of a flight.

    Parameters
    ----------
    logs : sequence of Path
        One or several logs of one flight.
    survey : Survey
    folder : Path
        Made where it is not there.
    progress : Progress
    poses : Path, optional
        A trajectory.csv from elsewhere, in UTC, to place the points with in place of the autopilot's.

    Returns
    -------
    dict
        What quality.json holds.
    """
    if survey.crs is not None:
        geodesy.projected_crs(survey.crs)  # a wrong code is said before the work, not after
    with contextlib.ExitStack() as stack:
        stack.enter_context(made_folder(folder))
        readers = [stack.enter_context(LogReader(path)) for path in logs]
        check_order(readers)
        mount, mount_source = find_mount(survey.mount, readers)
        flight = read_flight(readers, "ins", lambda done: progress("read", done))
        timeline = legs(flight.runs, flight.boots, mount.mat_ins_lidar(), survey.sync)
        trajectory = fly(timeline, survey, mount) if poses is None else read_trajectory(poses)
        frame = trajectory.frame
        code = survey.crs or geodesy.utm_epsg(frame.latitude_deg, frame.longitude_deg)
        projection = geodesy.Projection(frame, geodesy.projected_crs(code))
        tally, sample = write_cloud(readers, timeline, trajectory, mount, survey, projection, folder, progress)
        write_trajectory(folder / "trajectory.csv", trajectory)
        draw_cloud(folder, sample, projection.crs.name)
        quality = describe(readers, survey, mount, mount_source, flight, timeline, trajectory, projection, tally)
        with written_aside(folder / "quality.json") as aside:
            aside.write_text(json.dumps(quality, indent=2) + "\n", encoding="utf-8")
    return quality


def check_order(readers: list[LogReader]) -> None:
    """Sort logs by time; logs that overlap are not of one flight."""
    readers.sort(key=lambda reader: reader.start_ns)
    for before, after in itertools.pairwise(readers):
        if after.start_ns < before.end_ns - 1_000_000_000:
            raise UsageError(
                f"{before.path} and {after.path}: overlap in time; the parts of one flight follow each other"
            )


def fly(timeline: Sequence[Leg], survey: Survey, mount: Mount) -> Trajectory:
    """The trajectory of all legs, in the local frame of the first fix; a boot that never had one leaves a gap.

    Raises
    ------
    LogError
        No boot gives a trajectory, or its heights are not of the kind asked for.
    """
    # where none has a fix, the first boot says what is missing
    placed = [leg for leg in timeline if ins.has_position(leg.boot)] or list(timeline[:1])
    undulation_m = None
    if survey.geoid is not None:
        place = ins.position_fixes(placed[0].boot, "msl")
        undulation_m = geodesy.undulation(survey.geoid, float(place.latitude_deg[0]), float(place.longitude_deg[0]))
    fixes = [ins.position_fixes(leg.boot, survey.height, undulation_m) for leg in placed]
    first = fixes[0]
    frame = geodesy.LocalFrame(float(first.latitude_deg[0]), float(first.longitude_deg[0]), float(first.height_m[0]))
    grid_ns = None if survey.pose_grid_ms is None else round(survey.pose_grid_ms * 1e6)
    parts: list[Trajectory] = []
    reasons: list[LogError] = []
    for number, (leg, fix) in enumerate(zip(placed, fixes, strict=True)):
        try:
            part = ins.ins_trajectory(leg.boot, fix, frame, leg.utc_from_boot, mount, grid_ns)
        except LogError as error:
            reasons.append(error)
            continue
        # a boot that went on over a jump of the lidar's clock belongs to both legs: each has its own side
        if number and placed[number - 1].boot is leg.boot and parts:
            part = part.after(int(parts[-1].time_ns[-1]))
        if number + 1 < len(placed) and placed[number + 1].boot is leg.boot:
            part = part.before(int(leg.utc_from_lidar(np.array([leg.last_lidar_ns]))[0]))
        if len(part) > 1:
            parts.append(part)
    if reasons and not parts:
        raise reasons[0]
    return joined(parts)


# Points ---------------------------------------------------------------------------------------------------------------


def write_cloud(
    readers: Sequence[LogReader],
    timeline: Sequence[Leg],
    trajectory: Trajectory,
    mount: Mount,
    survey: Survey,
    projection: geodesy.Projection,
    folder: Path,
    progress: Progress,
) -> tuple[Tally, CloudSample]:
    """Place every packet and write cloud.laz."""
    tally, sample = Tally(), CloudSample()
    gate = Gate(*survey.fov_deg, survey.min_range_m, survey.max_range_m)
    start = projection.exact(trajectory.position_m[:1])[0]
    offset_m = [float(np.floor(start[0] / 100) * 100), float(np.floor(start[1] / 100) * 100), 0.0]
    with (
        written_aside(folder / "cloud.laz") as aside,
        las.CloudWriter(aside, [las.LASER, las.RANGE], crs=cloud_crs(projection, survey), offset_m=offset_m) as cloud,
    ):
        for packets, utc_ns in chunks(readers, timeline, tally, lambda done: progress("place", done)):
            points = georeference.georeference(packets, utc_ns, trajectory, mount, gate)
            tally.dropped = tally.dropped + points.dropped
            if len(points):
                project(points, projection)
                write_points(cloud, points)
                sample.add(points.xyz_m, points.intensity)
        tally.written = cloud.points
        if not tally.written:
            raise CoverageError(
                f"{readers[0].path}: not one of {tally.packets} lidar packets gives a point; "
                f"the trajectory covers {utc_text(int(trajectory.time_ns[0]))} to {utc_text(int(trajectory.time_ns[-1]))}, "
                f"and {tally.dropped.no_pose} shots lie outside it"
            )
    return tally, sample


def cloud_crs(projection: geodesy.Projection, survey: Survey) -> Any:
    """The CRS that the file states: with EGM 96 as the height reference where heights are above sea level."""
    return geodesy.with_sea_level(projection.crs) if survey.height == "msl" else projection.crs


def project(points: Points, projection: geodesy.Projection) -> None:
    """Put points into the projected CRS, in place."""
    georeference.project(points.xyz_m, projection.polynomial(*georeference.extent(points.xyz_m)))


def write_points(cloud: las.CloudWriter, points: Points) -> None:
    """Hand projected points to the file."""
    extras: dict[str, npt.NDArray[Any]] = {"laser": points.laser, "range": points.range_steps}
    cloud.write(points.xyz_m, las.gps_time_s(points.time_ns), points.intensity, points.returns, extras)


def chunks(
    readers: Sequence[LogReader], timeline: Sequence[Leg], tally: Tally, progress: Callable[[int], None]
) -> Iterator[tuple[npt.NDArray[np.void], npt.NDArray[np.int64]]]:
    """Packets of one return mode and one leg, about `CHUNK_PACKETS`, with the UTC of their stamps [ns]."""
    waiting: list[load.LidarBatch] = []
    size, first = 0, True
    for batch in load.lidar_batches(readers, progress):
        take_account(tally, batch)
        if not len(batch.packets):
            continue
        if first:
            sensor_model.refuse_other_models(batch.packets["data"], str(readers[0].path))
            first = False
        if waiting and (size >= CHUNK_PACKETS or not same_kind(waiting[-1], batch)):
            yield from in_utc(waiting, timeline, tally)
            waiting, size = [], 0
        waiting.append(batch)
        size += len(batch.packets)
    if waiting:
        yield from in_utc(waiting, timeline, tally)


def same_kind(before: load.LidarBatch, after: load.LidarBatch) -> bool:
    """Whether two batches may be placed together."""
    same_mode = before.packets["data"]["return_mode"][-1] == after.packets["data"]["return_mode"][0]
    return bool(same_mode) and not after.jumped


def in_utc(
    batches: Sequence[load.LidarBatch], timeline: Sequence[Leg], tally: Tally
) -> Iterator[tuple[npt.NDArray[np.void], npt.NDArray[np.int64]]]:
    """Join batches, give them UTC, and cut where the return mode changes within."""
    packets = load.joined([batch.packets for batch in batches])
    device_ns = np.concatenate([batch.device_time_ns for batch in batches])
    receive_ns = int(batches[0].receive_time_ns[0])
    leg = next(
        (leg for leg in timeline if leg.first_receive_ns - 10**9 <= receive_ns <= leg.last_receive_ns + 10**9), None
    )
    if leg is None:
        tally.packets_without_leg += len(packets)
        return
    yield from decode.by_mode(packets, leg.utc_from_lidar(device_ns))


def take_account(tally: Tally, batch: load.LidarBatch) -> None:
    """Add up what became of the packets before they reached the log."""
    tally.packets += len(batch.packets)
    if batch.account is not None:
        tally.masked_packets += batch.account.masked_packets
        tally.masked_blocks += batch.account.masked_blocks
        tally.kernel_drops += batch.account.kernel_drops
        tally.queue_drops += batch.account.queue_drops
        tally.rejected += batch.account.rejected_length + batch.account.rejected_content + batch.account.rejected_sender


# Quality --------------------------------------------------------------------------------------------------------------


def describe(
    readers: Sequence[LogReader],
    survey: Survey,
    mount: Mount,
    mount_source: str,
    flight: Flight,
    timeline: Sequence[Leg],
    trajectory: Trajectory,
    projection: geodesy.Projection,
    tally: Tally,
) -> dict[str, Any]:
    """What went in, what was dropped and why, and how well the clocks fit."""
    frame = projection.frame
    main = max(timeline, key=lambda leg: leg.sync.samples)
    seconds = np.diff(trajectory.time_ns) * 1e-9
    return {
        "software": {"swath": __version__, "log_format": FORMAT_VERSION},
        "inputs": [describe_log(reader) for reader in readers],
        "config": config.to_mapping(survey),
        "mount": config.to_mapping(mount) | {"source": mount_source},
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
            "method": survey.method,
            "start": utc_text(int(trajectory.time_ns[0])),
            "end": utc_text(int(trajectory.time_ns[-1])),
            "knots": len(trajectory),
            "covered_s": float(seconds[trajectory.covered[:-1]].sum()),
            "gaps_s": float(seconds[~trajectory.covered[:-1]].sum()),
            "median_sigma_m": np.median(trajectory.sigma_position_m, axis=0).tolist(),
            "sigma_source": ins.SIGMA_SOURCE,
        },
        "lidar": {
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
        "points": {"written": tally.written, "range_step_m": RANGE_LSB_M, "shots_dropped": asdict(tally.dropped)},
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
