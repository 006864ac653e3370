"""A job from start to end: its pieces in order, rendered by several threads, written as they come.

What is written does not depend on the number of threads.
"""

import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from flightlog.errors import SwathError
from simulator import checkpoints
from simulator.faults import Outage
from simulator.recording import FILES, IMAGES, POINTS, RTK, TRUTH, Recording
from simulator.rtk import solution
from simulator.simulation import Job, Simulation, in_order
from simulator.truth import write_json


def render(job: Job, progress: Callable[[float], object] | None = None) -> Simulation:
    """Simulate and write all files of a job; they get their names only when everything is there.

    Parameters
    ----------
    job : Job
    progress : callable, optional
        Called with the simulated seconds done since the last call.

    Raises
    ------
    SwathError
        The directory cannot be written.
    """
    names = [*FILES, *[POINTS] * job.truth_points, *[RTK] * (job.options.rtk.hz > 0), *[IMAGES] * bool(job.cameras)]
    parts = {name: job.directory / f"{name}.part" for name in names}
    simulation = Simulation(job)
    made = [folder for folder in (job.directory, *job.directory.parents) if not folder.exists()]
    try:
        job.directory.mkdir(parents=True, exist_ok=True)
        try:
            with Recording(simulation, parts) as recording:
                for chunk, sweep in enumerate(in_order(simulation, job.workers)):
                    recording.add(chunk, sweep)
                    if progress is not None:
                        start_s, end_s = simulation.bounds_s(chunk)
                        progress(end_s - start_s)
            _write_more(simulation, parts)
            write_json(parts[TRUTH], simulation.truth())
            if IMAGES in parts and (job.directory / IMAGES).exists():
                shutil.rmtree(job.directory / IMAGES)
            for name, part in parts.items():
                part.replace(job.directory / name)
            made = []
        finally:
            for part in parts.values():
                if part.is_dir():
                    shutil.rmtree(part)
                part.unlink(missing_ok=True)
            with suppress(OSError):  # folders that nothing came into go again
                for folder in made:
                    folder.rmdir()
    except OSError as error:
        raise SwathError(f"{error.filename or job.directory}: cannot be written ({error.strerror})") from None
    return simulation


def _write_more(simulation: Simulation, parts: dict[str, Path]) -> None:
    """What other instruments make: positions of a receiver with a base, photographs."""
    job = simulation.job
    if RTK in parts:
        text = solution(
            simulation.flight, job.options.rtk, simulation.clocks, simulation.origin, simulation.mount.gps_position_m,
            Outage.of(job.options.faults), job.seed,
        )  # fmt: skip
        parts[RTK].write_text(text, encoding="utf-8")
    if IMAGES in parts:
        if parts[IMAGES].exists():
            shutil.rmtree(parts[IMAGES])
        simulation.studio.write_all(parts[IMAGES], job.workers)
        checkpoints.write(simulation.studio, parts[IMAGES])
