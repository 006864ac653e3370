"""Many flights: one that fails stops no other, a killed worker changes nothing, and files may lie elsewhere."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
import yaml

from flightlog.hdl32e import ReturnMode
from groundproc.cli import main
from groundproc.field.madeup import write_flight

SETTINGS = {"method": "ins", "products": ["cloud.laz"]}


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    write_flight(folder / "a.mcap", 4.0, ReturnMode.STRONGEST)
    write_flight(folder / "b.mcap", 5.0, ReturnMode.STRONGEST)
    return folder


@pytest.fixture(scope="module")
def alone(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders `a` and `b` of what `swath process` makes of each."""
    folder = tmp_path_factory.mktemp("alone")
    for name in "ab":
        words = ["--method", "ins", "--products", "cloud.laz"]
        assert main(["process", str(logs / f"{name}.mcap"), "-o", str(folder / name), *words]) == 0
    return folder


def campaign(path: Path, output: str, flights: list[dict[str, Any]]) -> Path:
    path.write_text(yaml.safe_dump({"output": output, "survey": SETTINGS, "flights": flights}))
    return path


def outcomes(words: list[str], capsys: pytest.CaptureFixture[str], code: int) -> list[dict[str, Any]]:
    assert main(["batch", *words, "--json"]) == code
    found: list[dict[str, Any]] = json.loads(capsys.readouterr().out)
    return found


def test_a_flight_that_fails_is_named_and_stops_no_other(
    tmp_path: Path, logs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flights = [
        {"name": "gone", "logs": ["nowhere.mcap"]},
        {"name": "a", "logs": [str(logs / "a.mcap")], "survey": {"crs": 32633}},
    ]
    file = campaign(tmp_path / "flights.yaml", "out", flights)
    assert main(["batch", str(file), "--dry-run"]) == 0
    assert not (tmp_path / "out").exists()
    assert main(["batch", str(file), "--workers", "2"]) == 1
    told = capsys.readouterr()
    assert "nowhere.mcap" in told.err
    assert "2 flights, 1 failed" in told.out
    alone = tmp_path / "alone"
    words = ["--method", "ins", "--products", "cloud.laz", "--crs", "32633"]
    assert main(["process", str(logs / "a.mcap"), "-o", str(alone), *words]) in (0, 3)
    capsys.readouterr()
    for name in ("cloud.laz", "trajectory.csv"):
        assert (tmp_path / "out" / "a" / name).read_bytes() == (alone / name).read_bytes()


@pytest.mark.parametrize(
    ("tree", "words"),
    [
        ({"flights": [{"name": "a", "logs": ["a"]}]}, "output is missing"),
        ({"output": "o", "flights": []}, "flights is missing"),
        ({"output": "o", "flights": [{"name": "../a", "logs": ["a"]}]}, "name is '../a', expected letters"),
        ({"output": "o", "flights": [{"name": "a", "logs": [log]} for log in "ab"]}, "is that of another flight too"),
        ({"output": "o", "flights": [{"name": "a"}]}, "logs is missing"),
        ({"output": "o", "survey": {"cros": 1}, "flights": [{"name": "a", "logs": ["a"]}]}, "unknown key 'cros'"),
        ({"output": "o", "survey": [1], "flights": [{"name": "a", "logs": ["a"]}]}, "expected the name of a survey"),
    ],
)
def test_a_list_that_is_none_is_one_sentence(
    tmp_path: Path, tree: dict[str, Any], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "flights.yaml"
    file.write_text(yaml.safe_dump(tree))
    assert main(["batch", str(file)]) == 2
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """A bucket of a real S3 server on loopback."""
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    before = dict(os.environ)
    os.environ |= {
        "AWS_ACCESS_KEY_ID": "here",
        "AWS_SECRET_ACCESS_KEY": "here",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
    }
    try:
        import s3fs

        s3fs.S3FileSystem(skip_instance_cache=True).mkdir("flights")
        yield "s3://flights"
    finally:
        os.environ.clear()
        os.environ.update(before)
        server.stop()


def test_logs_and_products_may_lie_in_a_bucket(
    tmp_path: Path, logs: Path, alone: Path, bucket: str, capsys: pytest.CaptureFixture[str]
) -> None:
    import s3fs

    system = s3fs.S3FileSystem()
    system.put_file(str(logs / "a.mcap"), "flights/in/a.mcap")
    flights = [{"name": "a", "logs": [f"{bucket}/in/a.mcap"]}, {"name": "gone", "logs": [f"{bucket}/in/none.mcap"]}]
    file = campaign(tmp_path / "flights.yaml", f"{bucket}/out", flights)
    found = outcomes([str(file)], capsys, 1)
    assert found[0]["verdict"] != "failed", found[0]
    assert found[1]["said"] == [f"swath: {bucket}/in/none.mcap: is not there"]
    system.invalidate_cache()
    assert system.cat_file("flights/out/a/cloud.laz") == (alone / "a" / "cloud.laz").read_bytes()
    again = outcomes([str(file)], capsys, 1)[0]
    assert again["skipped"]
    assert again["points"] == found[0]["points"] > 0


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, list["subprocess.Popen[bytes]"]]]:
    """Address of a Dask scheduler and two workers of one thread each, in processes of their own."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    run = [sys.executable, "-W", "ignore", "-m", "distributed.cli.dask_scheduler"]
    work = [sys.executable, "-W", "ignore", "-m", "distributed.cli.dask_worker", address, "--nthreads", "1"]
    work += ["--no-nanny", "--no-dashboard", "--local-directory", str(tmp_path)]
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    port = address.rpartition(":")[2]
    scheduler = subprocess.Popen([*run, "--host", "127.0.0.1", "--port", port, "--no-dashboard"], **quiet)
    workers = [subprocess.Popen(work, **quiet) for _ in range(2)]
    try:
        yield address, workers
    finally:
        for process in (*workers, scheduler):
            process.kill()
            process.wait()


def test_a_killed_worker_of_a_cluster_changes_nothing_in_the_result(
    tmp_path: Path, logs: Path, alone: Path, cluster: tuple[str, list["subprocess.Popen[bytes]"]],
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    address, workers = cluster
    flights = [{"name": name, "logs": [str(logs / f"{name}.mcap")]} for name in "ab"]
    killed: list[int] = []

    def kill() -> None:
        """The first worker that has a flight, in the middle of it."""
        deadline = time.monotonic() + 300.0
        while not killed and time.monotonic() < deadline:
            for worker in workers:
                if any("process" in child.cmdline() for child in psutil.Process(worker.pid).children()):
                    os.kill(worker.pid, signal.SIGKILL)
                    killed.append(worker.pid)
                    return
            time.sleep(0.05)

    thread = threading.Thread(target=kill)
    thread.start()
    on_cluster = campaign(tmp_path / "flights.yaml", "cluster", flights)
    found = outcomes([str(on_cluster), "--scheduler", address], capsys, 0)
    thread.join()
    assert killed
    assert [each["verdict"] for each in found] == ["good", "good"], found
    for name in "ab":
        for product in ("cloud.laz", "trajectory.csv"):
            assert (tmp_path / "cluster" / name / product).read_bytes() == (alone / name / product).read_bytes()


def test_a_scheduler_that_is_not_there_is_one_sentence(
    tmp_path: Path, logs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        file = campaign(tmp_path / "flights.yaml", "out", [{"name": "a", "logs": [str(logs / "a.mcap")]}])
        assert main(["batch", str(file), "--scheduler", address]) == 1
    assert "no Dask scheduler answers there" in capsys.readouterr().err


@pytest.mark.parametrize("workers", ["1", "2"])
def test_who_ends_a_campaign_ends_its_flights(tmp_path: Path, logs: Path, workers: str) -> None:
    """By its process alone, as `kill` and service managers do: a terminal's Ctrl-C reaches the flights anyway."""
    flights = [{"name": name, "logs": [str(logs / f"{name}.mcap")]} for name in "ab"]
    file = campaign(tmp_path / "flights.yaml", "out", flights)
    endless = "import time; time.sleep(600)"
    code = (
        f"import sys; from groundproc.campaign import flight; flight._PROGRAM = {endless!r};"
        " from groundproc.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    words = [sys.executable, "-c", code, "batch", str(file), "--workers", workers]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        parent, children = psutil.Process(process.pid), list[psutil.Process]()
        deadline = time.monotonic() + 120.0
        while len(children) < int(workers) and time.monotonic() < deadline:
            children = [child for child in parent.children() if endless in child.cmdline()]
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 143
        assert process.stderr is not None
        assert "Traceback" not in process.stderr.read()
    assert len(children) == int(workers)
    assert not any(child.is_running() for child in children)


def test_what_is_up_to_date_is_said_to_be(tmp_path: Path, logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "nord-ö").mkdir()
    flights = [{"name": "flug-ä", "logs": [str(logs / "a.mcap")]}]
    file = campaign(tmp_path / "nord-ö" / "flüge.yaml", "out", flights)
    first = outcomes([str(file)], capsys, 0)[0]
    made = (tmp_path / "nord-ö" / "out" / "flug-ä" / "quality.json").stat().st_mtime_ns
    second = outcomes([str(file)], capsys, 0)[0]
    assert [first["skipped"], second["skipped"]] == [False, True]
    assert first["points"] == second["points"] > 0
    assert first["said"] == []  # what a good flight has to say is its verdict
    assert (tmp_path / "nord-ö" / "out" / "flug-ä" / "quality.json").stat().st_mtime_ns == made
    assert not outcomes([str(file), "--force"], capsys, 0)[0]["skipped"]


def test_a_dry_run_names_logs_that_are_not_there(
    tmp_path: Path, logs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flights = [{"name": "a", "logs": [str(logs / "a.mcap")]}, {"name": "b", "logs": [str(logs / "bb.mcap")]}]
    assert main(["batch", str(campaign(tmp_path / "flights.yaml", "out", flights)), "--dry-run"]) == 0
    told = capsys.readouterr()
    assert told.out.count("\n") == 2
    assert told.err == f"swath: warning: b: {logs}/bb.mcap: no such file; there is {logs}/b.mcap\n"


def test_a_bad_flight_is_bad_and_its_products_are_there(tmp_path: Path, logs: Path, bucket: str) -> None:
    """By a stand-in for `swath process` that ends as that does on a bad flight: exit code 1, and quality.json printed."""
    from groundproc.campaign import flight
    from groundproc.campaign.flights import load_jobs

    quality = {"verdict_reasons": [{"grade": "bad", "about": "x", "text": "y"}], "points": {"written": 7}}
    told = json.dumps(quality)
    stand_in = (
        "import sys, pathlib; folder = pathlib.Path(sys.argv[sys.argv.index('-o') + 1]); folder.mkdir(parents=True, exist_ok=True);"
        f" (folder / 'quality.json').write_text({told!r}); print({told!r}); sys.exit(1)"
    )
    flights = [{"name": "a", "logs": [str(logs / "a.mcap")]}]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flight, "_PROGRAM", stand_in)
        for place in ("out", f"{bucket}/bad"):
            found = flight.run_flight(load_jobs(campaign(tmp_path / "flights.yaml", place, flights), force=False)[0])
            assert (found.exit_code, found.verdict, found.points) == (1, "bad", 7)
    import s3fs

    assert json.loads(s3fs.S3FileSystem(skip_instance_cache=True).cat_file("flights/bad/a/quality.json")) == quality
