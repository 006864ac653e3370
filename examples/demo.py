"""A survey from take-off to cloud: a simulated flight, live, into the real recorder, and on to the products.

Run by `make demo`. Every step is a command that anyone can type; this script only starts them and says what they did.

    simulated sensors --UDP, serial--> swathd run --> flight log --> swath info, swath process --> cloud, trajectory, pictures
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

FOLDER = Path("demo")
SIMULATION, FLIGHT, PRODUCTS = FOLDER / "simulation", FOLDER / "flight", FOLDER / "products"
BIN = Path(sys.executable).parent
DURATION_S = 20
SETTLE_S = 2
"""From the opening of the serial line to take-off: time for the recorder to find it."""


def say(text: str) -> None:
    """Tell the user, at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def step(title: str, *words: object) -> list[str]:
    """Announce a command and give it as words."""
    command = [str(BIN / str(words[0])), *map(str, words[1:])]
    say(f"\n== {title}\n$ {' '.join(map(str, words))}")
    return command


def free_ports(count: int) -> list[int]:
    """UDP ports of this machine that nobody uses."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [int(one.getsockname()[1]) for one in sockets]
    for one in sockets:
        one.close()
    return ports


def recorder_config(lidar_port: int, position_port: int, serial: Path) -> str:
    """The few options in which the demo differs from an aircraft."""
    return (
        f"lidar:\n  address: 127.0.0.1\n  data_port: {lidar_port}\n  position_port: {position_port}\n"
        f"ins:\n  device: {serial.absolute()}\n"
        f"recorder:\n  directory: {FLIGHT.absolute()}\n"
    )


def fly() -> Path:
    """Simulate, play live into swathd, stop it, and give the log that it wrote."""
    serial, config = FOLDER / "serial", FOLDER / "swathd.yaml"
    lidar_port, position_port = free_ports(2)
    config.write_text(recorder_config(lidar_port, position_port, serial))
    command = step(
        f"render {DURATION_S} s of flight, then play it in real time",
        "swath", "simulate", "--duration", DURATION_S, "-o", SIMULATION, "--live", "--lidar-port", lidar_port,
        "--position-port", position_port, "--pty-link", serial, "--wait", SETTLE_S,
    )  # fmt: skip
    started = time.monotonic()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as sensors:
        assert sensors.stdout is not None
        recorder = None
        try:
            for line in sensors.stdout:
                say(line.rstrip())
                if line.startswith("MAVLink on "):
                    say(f"rendered in {time.monotonic() - started:.0f} s")
                    recorder = subprocess.Popen(step("the real recorder", "swathd", "run", "--config", config))
        finally:
            if recorder is not None:
                recorder.send_signal(signal.SIGTERM)
                recorder.wait(timeout=20)
    if sensors.returncode or recorder is None or recorder.returncode:
        raise SystemExit("the flight could not be simulated or recorded; see above")
    logs = sorted(FLIGHT.glob("*.mcap"))
    if len(logs) != 1:
        raise SystemExit(f"{FLIGHT}: {len(logs)} logs found, expected the one of this flight")
    return logs[0]


def complete(code: int) -> None:
    """Go on after what is good, and after what is doubtful: a busy computer may lose packets of a flight in real time."""
    if code not in (0, 3):
        raise SystemExit(code)


def look(log: Path) -> None:
    """What the log holds."""
    command = step("what was recorded", "swath", "info", log)
    run = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    complete(run.returncode)
    say("\n".join(line for line in run.stdout.splitlines() if not line.startswith("  1/1 ")))


def process(log: Path) -> None:
    """Make the cloud, the trajectory and the pictures."""
    command = step("from packets to a georeferenced cloud", "swath", "process", log, "-o", PRODUCTS)
    complete(subprocess.run(command, check=False).returncode)


def main() -> int:
    """Fly, look, process, and say where to look."""
    os.chdir(Path(__file__).resolve().parents[1])
    for folder in (SIMULATION, FLIGHT, PRODUCTS):
        shutil.rmtree(folder, ignore_errors=True)
    FOLDER.mkdir(exist_ok=True)
    started = time.monotonic()
    log = fly()
    look(log)
    process(log)
    say(f"\n== done in {time.monotonic() - started:.0f} s; look at")
    for path in [log, *sorted(PRODUCTS.iterdir())]:
        say(f"  {path}  ({path.stat().st_size / 1e6:.2f} MB)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
