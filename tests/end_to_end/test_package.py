"""Debian's package: what is in it, and that it installs, records, is upgraded, removed and purged in a booted system without a network."""

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from guest import ROOT, Guest, needs

NEEDED = ("python3-lz4", "python3-numpy", "python3-serial", "python3-systemd", "python3-yaml", "python3-zstandard")
OFFLINE = (
    "No matching distribution",
    "Could not fetch",
    "Failed to establish",
    "Temporary failure",
    "ProxyError",
    "Connection",
)
ARCHITECTURES = ("amd64", "arm64")


def there(package: str) -> bool:
    """Whether a Debian package is installed here."""
    done = subprocess.run(["dpkg-query", "-W", "-f", "${Status}", package], capture_output=True, text=True, check=False)
    return "ok installed" in done.stdout


def builder() -> ModuleType:
    """The program that builds."""
    spec = importlib.util.spec_from_file_location("deb", ROOT / "package" / "deb.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


if shutil.which("dpkg-deb") is None:
    pytest.skip("dpkg-deb is not installed", allow_module_level=True)
if missing := [name for name in NEEDED if not there(name)]:
    pytest.skip(f"not installed: {', '.join(missing)}", allow_module_level=True)
for tool in ("x86_64-linux-gnu-strip", "aarch64-linux-gnu-strip"):
    if shutil.which(tool) is None:
        pytest.skip(f"not installed: {tool}", allow_module_level=True)


def make(folder: Path, *words: str) -> None:
    """Build as `make deb` does; without a network and without the wheels the test is skipped."""
    command = [sys.executable, ROOT / "package" / "deb.py", "--output", folder, *words]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)})
    if done.returncode and any(words in done.stderr for words in OFFLINE):
        pytest.skip("pip reaches no package index: the wheels that the package carries cannot be fetched")
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def debs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both architectures."""
    folder = tmp_path_factory.mktemp("debs")
    make(folder)
    return folder


@pytest.fixture(scope="module")
def tree(debs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the package, unpacked."""
    folder = tmp_path_factory.mktemp("tree")
    subprocess.run(["dpkg-deb", "-x", next(debs.glob("swathd_0*_amd64.deb")), folder], check=True)
    return folder


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_it_is_small_and_of_the_architecture_that_it_states(debs: Path, architecture: str, tmp_path: Path) -> None:
    (deb,) = debs.glob(f"swathd_0*_{architecture}.deb")
    assert deb.stat().st_size < 15e6
    fields = subprocess.run(["dpkg-deb", "-f", deb], capture_output=True, text=True, check=True).stdout
    assert f"Architecture: {architecture}" in fields
    for name in NEEDED:
        assert name in fields
    subprocess.run(["dpkg-deb", "-x", deb, tmp_path], check=True)
    (compiled,) = tmp_path.rglob("*.so")
    machine = {"amd64": 62, "arm64": 183}[architecture]  # e_machine of ELF
    assert int.from_bytes(compiled.read_bytes()[18:20], "little") == machine


# the package is built once more
@pytest.mark.soak
def test_the_same_sources_make_the_same_bytes(debs: Path, tmp_path: Path) -> None:
    make(tmp_path, "amd64")
    (first,), (second,) = debs.glob("swathd_0*_amd64.deb"), tmp_path.glob("*.deb")
    assert first.read_bytes() == second.read_bytes()


# reads every file of both packages; in the quick suite: what is in them, and that they install and run
@pytest.mark.soak
@pytest.mark.skipif(shutil.which("lintian") is None, reason="lintian is not installed")
def test_lintian_finds_nothing(debs: Path) -> None:
    done = subprocess.run(["lintian", "--allow-root", *debs.glob("swathd_0*.deb")], capture_output=True, text=True)
    assert done.returncode == 0
    assert re.findall(r"^[EW]: .*", done.stdout, re.MULTILINE) == []


def test_the_program_runs_with_debians_own_packages_alone(tree: Path) -> None:
    program = tree / "usr/bin/swathd"

    def run(*words: str) -> str:
        return subprocess.run([program, *words], capture_output=True, text=True, check=True, cwd="/").stdout

    assert run("--version").split()[1] == builder().version()
    assert run("config") == (tree / "etc/swathd/swathd.yaml").read_text()
    look = (
        "import sys; from pathlib import Path; home = Path(sys.argv[1]); sys.path[:0] = [str(home), str(home / 'vendor')]\n"
        "import importlib, pkgutil, flightlog, onboard\n"
        "names = [m.name for p in (flightlog, onboard) for m in pkgutil.walk_packages(p.__path__, p.__name__ + '.')]\n"
        "for name in names: importlib.import_module(name)\n"
        "import lz4, numpy, pymavlink, serial, systemd, yaml, zstandard, fastcrc\n"
        "ours = [m.__file__ for m in (flightlog, onboard, pymavlink, fastcrc) if not Path(m.__file__).is_relative_to(home)]\n"
        "theirs = [m.__file__ for m in (lz4, numpy, serial, systemd, yaml, zstandard) if '/usr/lib/python3/' not in m.__file__]\n"
        "print(len(names), ours, theirs)\n"
    )
    done = subprocess.run(
        ["/usr/bin/python3", "-I", "-B", "-c", look, tree / "usr/lib/swathd"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    count, *rest = done.stdout.split(maxsplit=1)
    assert int(count) > 50
    assert rest == ["[] []\n"]


def test_the_man_pages_name_every_command_and_every_option(tree: Path) -> None:
    import gzip

    from flightlog.config import to_mapping
    from onboard.cli import _parser
    from onboard.config import SwathdConfig

    page = gzip.decompress((tree / "usr/share/man/man8/swathd.8.gz").read_bytes()).decode()
    for name, _, child in builder_pages().commands(_parser()):
        assert f".B {name}" in page
        for action in child._actions:
            for word in action.option_strings:
                assert word in ("-h", "--help") or word.replace("-", "\\-") in page
    options = gzip.decompress((tree / "usr/share/man/man5/swathd.yaml.5.gz").read_bytes()).decode()

    def leaves(node: object, prefix: str) -> list[str]:
        if not isinstance(node, dict):
            return [prefix]
        return [leaf for key, value in node.items() for leaf in leaves(value, f"{prefix}.{key}" if prefix else key)]

    for leaf in leaves(to_mapping(SwathdConfig()), ""):
        assert f".B {leaf}\n" in options
    for path in (tree / "usr/share/man").rglob("*.gz"):
        if shutil.which("man"):
            done = subprocess.run(["man", "--warnings", "-l", path], capture_output=True, text=True)
            assert (done.returncode, done.stderr) == (0, "")


def builder_pages() -> ModuleType:
    builder()  # puts its folder on the path
    return importlib.import_module("manpages")


# In a booted system ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def guest(debs: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guest]:
    """A system without swathd and without a network, with the package and a later version of it in /srv."""
    folder = tmp_path_factory.mktemp("guest")
    make(debs, "amd64", "--version", "99.0")
    # a computer of its own lets services be started, and has no desktop that looks for updates after each installation
    others = "usr/sbin/policy-rc.d etc/apt/apt.conf.d/20packagekit"
    prepare = (
        f"rm -rf opt/swath etc/ssh/sshd_config.d/60-swathd.conf {others}; mkdir -p srv; cp {debs}/*_amd64.deb srv/"
    )
    guest = Guest(folder, prepare)
    try:
        guest.boot()
        yield guest
    finally:
        guest.stop()


def install(guest: Guest, version: str) -> str:
    return guest.enter("sh", "-c", f"apt-get install -y -q /srv/swathd_{version}_amd64.deb 2>&1")


pytest_root = [*needs, pytest.mark.skipif(os.uname().machine != "x86_64", reason="the guest is of this machine's kind")]


def rooted(function):  # type: ignore[no-untyped-def]
    for mark in pytest_root:
        function = mark(function)
    return function


@rooted
def test_it_installs_without_a_network_and_records(guest: Guest) -> None:
    version = builder().version()
    with guest.sending():
        install(guest, version)
        guest.wait_for(lambda: guest.show("ActiveState") == "active")
        guest.wait_for(lambda: guest.path("/run/swathd/status.json").exists() and guest.status()["lidar"]["kept"] > 0)
    assert guest.show("UnitFileState") == "enabled"
    assert guest.show("FragmentPath") == "/lib/systemd/system/swathd.service"
    assert f"swathd {version}" in guest.enter("swathd", "--version")
    assert guest.enter("id", "-un", str(guest.path(f"/proc/{guest.pid}").stat().st_uid)).strip() == "swath"
    words = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "/usr/bin/swathd", "health", "--json"]
    assert json.loads(guest.enter(*words, check=False))["status"]["pid"] == guest.pid
    # what was compiled at installation is what runs: the service itself cannot write there
    assert guest.path("/usr/lib/swathd/onboard/__pycache__/daemon.cpython-311.pyc").exists()


@rooted
def test_the_packaged_unit_is_as_closed_as_the_other(guest: Guest) -> None:
    told = guest.enter("systemd-analyze", "security", "swathd.service", "--no-pager", check=False)
    found = re.search(r"Overall exposure level for swathd.service: ([0-9.]+)", told)
    assert found is not None, told
    assert float(found[1]) <= 1.2


@rooted
def test_the_lidars_port_is_set_up_by_its_owner(guest: Guest) -> None:
    refused = guest.enter("sh", "-c", "swathd install 2>&1 || echo code $?")
    assert "is Debian's package here" in refused
    assert "code 2" in refused
    assert "apt remove swathd" in guest.enter("sh", "-c", "swathd uninstall 2>&1 || true")
    guest.enter("swathd", "install", "--lidar-interface", "lidar0")
    guest.wait_for(lambda: "192.168.1.100/24" in guest.enter("ip", "-br", "-4", "addr", "show", "lidar0"))


@rooted
def test_an_upgrade_keeps_configuration_and_recordings_and_records_on(guest: Guest) -> None:
    config = guest.path("/etc/swathd/swathd.yaml")
    config.write_text(config.read_text().replace("min_range", "min_range") + "# mine\n")
    before = sorted(path.name for path in guest.path("/var/lib/swathd").glob("*.mcap"))
    assert before
    first = guest.pid
    install(guest, "99.0")
    guest.wait_for(lambda: guest.show("ActiveState") == "active" and guest.pid != first)
    assert "swathd 99.0" in guest.enter("swathd", "--version")
    assert config.read_text().endswith("# mine\n")
    after = sorted(path.name for path in guest.path("/var/lib/swathd").glob("*.mcap"))
    assert set(before) < set(after)
    manifest = guest.path("/var/lib/swathd/manifest.jsonl").read_text()
    assert before[0] in manifest  # closed, not cut off


# one more installation in a booted system
@pytest.mark.soak
@rooted
def test_a_service_that_its_owner_has_disabled_stays_so(guest: Guest) -> None:
    guest.systemctl("disable", "--now", "swathd.service")
    guest.enter("sh", "-c", "apt-get install -y -q --allow-downgrades /srv/swathd_0*_amd64.deb 2>&1")
    assert guest.show("UnitFileState") == "disabled"
    guest.systemctl("enable", "--now", "swathd.service")


@rooted
def test_removing_leaves_recordings_and_configuration_and_purging_the_recordings(guest: Guest) -> None:
    guest.wait_for(lambda: guest.show("ActiveState") == "active")
    logs = sorted(path.name for path in guest.path("/var/lib/swathd").glob("*.mcap"))
    guest.enter("apt-get", "remove", "-y", "-q", "swathd")
    assert guest.show("ActiveState") == "inactive"
    assert sorted(path.name for path in guest.path("/var/lib/swathd").glob("*.mcap")) == logs
    assert guest.path("/etc/swathd/swathd.yaml").read_text().endswith("# mine\n")
    assert not guest.path("/usr/bin/swathd").exists()
    assert not guest.path("/usr/lib/swathd").exists()  # nor what was compiled there
    said = guest.enter("sh", "-c", "apt-get purge -y -q swathd 2>&1 </dev/null")
    assert sorted(path.name for path in guest.path("/var/lib/swathd").glob("*.mcap")) == logs, said
    assert not guest.path("/etc/swathd/swathd.yaml").exists()
    assert guest.enter("id", "-u", "swath").strip().isdigit()  # the recordings are still somebody's
    assert guest.show("LoadState") == "not-found"
