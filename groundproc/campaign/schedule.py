"""Who does the work: processes of this computer, or the workers of a Dask cluster."""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed

from flightlog.errors import SourceError, UsageError
from groundproc.campaign.flight import Outcome, Running, run_flight
from groundproc.campaign.flights import Job


def outcomes(jobs: Sequence[Job], scheduler: str | None, workers: int) -> Iterator[Outcome]:
    """Do all jobs; give what became of each as it ends.

    Parameters
    ----------
    jobs : sequence of Job
    scheduler : str or None
        Address of a Dask scheduler, such as tcp://host:8786; None: this computer.
    workers : int
        Flights at a time on this computer; they share its cores.

    Raises
    ------
    SourceError
        The scheduler cannot be reached.
    """
    return _here(jobs, workers) if scheduler is None else _on_cluster(jobs, scheduler)


def _here(jobs: Sequence[Job], workers: int) -> Iterator[Outcome]:
    cores = os.cpu_count() or 1
    threads = None if workers == 1 else max(1, cores // workers)
    processes = Running()
    with ThreadPoolExecutor(workers) as pool:
        running = [pool.submit(run_flight, job, threads, processes) for job in jobs]
        try:
            for each in as_completed(running):
                yield each.result()
        except BaseException:  # raised again: the pool waits for its threads, and these for their processes
            for each in running:
                each.cancel()
            processes.end()
            raise


def _on_cluster(jobs: Sequence[Job], scheduler: str) -> Iterator[Outcome]:
    """A flight whose worker is lost is begun again by another; each flight is written whole or not at all."""
    try:
        from dask.distributed import Client
        from dask.distributed import as_completed as ended
    except ModuleNotFoundError:
        raise UsageError(
            f"--scheduler {scheduler}: needs Dask, which is not installed; pip install 'swath[cluster]'"
        ) from None
    try:
        client = Client(scheduler, timeout="5s", set_as_default=False)  # type: ignore[no-untyped-call]  # nor is Dask typed
    except (OSError, ValueError, TimeoutError) as error:
        raise SourceError(f"--scheduler {scheduler}: no Dask scheduler answers there ({error})") from None
    with client:
        running = [client.submit(_on_worker, job, pure=False, key=f"swath-{job.name}", retries=2) for job in jobs]
        named = dict(zip((each.key for each in running), jobs, strict=True))
        for each in ended(running, loop=client.loop):  # type: ignore[no-untyped-call]
            if each.status == "finished":
                yield each.result()
            else:
                job = named[each.key]
                said = (f"swath: the worker failed ({each.exception()})",)
                yield Outcome(job.name, job.output, 1, "failed", 0.0, 0, said)


def _on_worker(job: Job) -> Outcome:
    """The job, with as many cores as the worker has threads."""
    from dask.distributed import get_worker

    return run_flight(job, get_worker().state.nthreads)
