"""The wheel: what is in it, and that each side installs and runs from it, the aircraft's with nothing of the ground's."""

import json
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
GROUND_ONLY = ("scipy", "numba", "pyproj", "laspy", "lazrs", "matplotlib", "tqdm", "embreex", "pytest")

LOOK = f"""
import importlib.util, json, pkgutil, sys
import flightlog, onboard
names = []
for package in (flightlog, onboard):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        __import__(module.name)
        names.append(module.name)
there = [name for name in {GROUND_ONLY!r} if importlib.util.find_spec(name)]
print(json.dumps({{"modules": names, "there": there, "file": flightlog.__file__}}))
"""


OFFLINE = ("No matching distribution", "Could not fetch", "Failed to establish", "Temporary failure", "ProxyError")
TYPED = ("flightlog", "groundproc", "onboard", "simulator")


def pip(python: Path | str, *words: str | Path) -> None:
    """Run pip; without a network the test is skipped."""
    command = [python, "-m", "pip", *words, "--quiet", "--disable-pip-version-check", "--retries", "1"]
    run = subprocess.run(command, capture_output=True, text=True)
    if run.returncode and any(words in run.stderr for words in OFFLINE):
        pytest.skip("pip reaches no package index: neither the wheel nor an environment for it can be made")
    assert run.returncode == 0, run.stderr


def environment(folder: Path) -> Path:
    """The bin folder of a new environment with nothing in it, pip neither."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    return folder / "bin"


def install(made: Path, *words: str | Path) -> None:
    """Install into an environment, by the pip of the one that runs the tests: a pip for each would take as long as the rest."""
    pip(sys.executable, "--python", made / "python", "install", "--no-compile", *words)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built once, out of a copy of what is in the repository, so that building leaves nothing in the source tree."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    for name in filter(None, tracked.decode().split("\x00")):
        if not name.startswith(("docs/", "tests/", "benchmarks/")) and (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    pip(sys.executable, "wheel", "--no-deps", "--wheel-dir", folder, source)
    (made,) = folder.glob("*.whl")
    return made


def test_the_wheel_is_for_any_system(wheel: Path) -> None:
    assert wheel.name.endswith("-py3-none-any.whl")
    with zipfile.ZipFile(wheel) as packed:
        assert [name for name in packed.namelist() if name.endswith((".so", ".pyd", ".dylib"))] == []


@pytest.fixture(scope="module")
def base(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bin folder of an environment with the wheel and what it needs in any case."""
    made = environment(tmp_path_factory.mktemp("base") / "venv")
    install(made, wheel)
    return made


@pytest.fixture(scope="module")
def bare(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with `[onboard]`: what an aircraft has, and nothing else."""
    made = environment(tmp_path_factory.mktemp("bare") / "venv")
    install(made, f"{wheel}[onboard]")
    return made


@pytest.fixture(scope="module")
def ground(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel alone, over the libraries of the environment that runs the tests.

    To install `[ground]` in full takes minutes (numba, scipy, matplotlib); what it asks for is held against what is there instead.
    """
    made = environment(tmp_path_factory.mktemp("ground") / "venv")
    install(made, "--no-deps", wheel)
    own = Path(call(made, "python", "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    (own / "libraries.pth").write_text("".join(f"{path}\n" for path in sys.path if path.endswith("site-packages")))
    return made


def call(bare: Path, *words: str) -> str:
    """Standard output of a command of the bare environment, run where the source tree is not on the path."""
    return subprocess.run([bare / words[0], *words[1:]], cwd=bare, capture_output=True, text=True, check=True).stdout


def test_all_of_flightlog_and_onboard_imports_without_any_library_of_the_ground(bare: Path) -> None:
    found = json.loads(call(bare, "python", "-c", LOOK))
    assert Path(found["file"]).is_relative_to(bare.parent)
    assert found["there"] == []
    assert {"flightlog.logfile", "flightlog.mavlink", "onboard.cli", "onboard.daemon"} <= set(found["modules"])


def test_the_daemon_says_how_to_use_it(bare: Path) -> None:
    assert "run" in call(bare, "swathd", "--help")


def test_the_daemon_prints_a_configuration_that_it_takes(bare: Path, tmp_path: Path) -> None:
    sample = call(bare, "swathd", "config")
    assert "lidar:" in sample
    path = tmp_path / "swathd.yaml"
    path.write_text(sample)
    check = "import sys; from flightlog.config import load; from onboard.config import SwathdConfig; load(sys.argv[1], SwathdConfig)"
    call(bare, "python", "-c", check, str(path))


def test_the_wheel_has_the_files_of_the_service(bare: Path) -> None:
    look = "from onboard import install; print(install.template('swathd.service'))"
    assert "WatchdogSec" in call(bare, "python", "-c", look)


# the base alone is a third environment; what `bare` has besides, its commands' help does not use
@pytest.mark.parametrize("where", [pytest.param("base", marks=pytest.mark.soak), "bare", "ground"])
def test_both_commands_say_how_to_use_them(request: pytest.FixtureRequest, where: str) -> None:
    made: Path = request.getfixturevalue(where)
    assert "usage: swathd" in call(made, "swathd", "--help")
    said = call(made, "swath", "--help")
    assert "usage: swath" in said
    assert {"process", "live", "pull", "simulate"} <= set(said.replace(",", " ").split())


# the base alone is a third environment; what `bare` has besides, its commands' help does not use
@pytest.mark.parametrize("where", [pytest.param("base", marks=pytest.mark.soak), "bare", "ground"])
def test_what_is_installed_is_the_wheel_and_says_its_licence(request: pytest.FixtureRequest, where: str) -> None:
    look = (
        "import flightlog, importlib.metadata, json; found = importlib.metadata.distribution('swath');"
        "print(json.dumps({'file': flightlog.__file__, 'version': found.version, 'ours': flightlog.__version__,"
        "'licence': found.metadata['License-Expression'], 'files': [str(f) for f in found.files]}))"
    )
    made: Path = request.getfixturevalue(where)
    found = json.loads(call(made, "python", "-c", look))
    assert Path(found["file"]).is_relative_to(made.parent)
    assert found["version"] == found["ours"]
    assert found["licence"] == "Apache-2.0"
    assert any(name.endswith("licenses/LICENSE") for name in found["files"])


# the third environment, as above; in the quick suite all of flightlog is imported in `bare`
@pytest.mark.soak
def test_the_base_reads_a_flight_log(base: Path) -> None:
    call(base, "python", "-c", "import flightlog.logfile, flightlog.mavlink, flightlog.salvage, flightlog.dataflash")


def test_all_of_the_ground_imports_with_the_libraries_that_ground_asks_for(ground: Path) -> None:
    look = (
        "import importlib.metadata as m, json, pkgutil, groundproc;"
        "names = [module.name for module in pkgutil.walk_packages(groundproc.__path__, 'groundproc.')];"
        "[__import__(name) for name in names];"
        "print(json.dumps({'names': names, 'file': groundproc.__file__, 'requires': m.requires('swath')}))"
    )
    found = json.loads(call(ground, "python", "-c", look))
    assert Path(found["file"]).is_relative_to(ground.parent)
    assert len(found["names"]) > 50
    asked = [Requirement(line) for line in found["requires"]]
    wanted = [each for each in asked if each.marker is None or each.marker.evaluate({"extra": "ground"})]
    assert {"numpy", "scipy", "numba", "laspy", "pyproj"} <= {each.name for each in wanted}
    for each in wanted:
        assert each.specifier.contains(version(each.name)), each


def test_types_data_and_licence_are_in_the_wheel_and_no_tests(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert {f"{package}/py.typed" for package in TYPED} <= names
    for data in ROOT.glob("groundproc/**/*.html"):
        assert str(data.relative_to(ROOT)) in names
    for data in (*ROOT.glob("simulator/flights/*.yaml"), *ROOT.glob("firmware_config/*.[yp]a[mr]*")):
        assert str(data.relative_to(ROOT)) in names
    tops = {name.split("/")[0] for name in names}
    assert {name for name in tops if not name.startswith("swath-")} == {*TYPED, "firmware_config"}
    modules = {str(path.relative_to(ROOT)) for package in TYPED for path in (ROOT / package).rglob("*.py")}
    assert {name for name in names if name.endswith(".py")} - {"firmware_config/__init__.py"} == modules
