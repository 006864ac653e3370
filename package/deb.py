"""Builds swathd_VERSION_ARCHITECTURE.deb for the payload computer: Debian 12, or Raspberry Pi OS of 64 bit.

The tree is laid out here and packed by dpkg-deb. Of the Python packages that swathd needs all but two are Debian's own; these two are
fetched as wheels by the hashes in deb/wheels.txt, and nothing is compiled, so that one machine builds for every architecture.
Same sources, same bytes: times are those of the last commit.
"""

import argparse
import gzip
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from datetime import UTC, datetime
from email.utils import format_datetime
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
DEB: Final = ROOT / "package" / "deb"
sys.path[:0] = [str(ROOT), str(ROOT / "package")]

PLATFORMS: Final = {"amd64": "manylinux2014_x86_64", "arm64": "manylinux2014_aarch64"}
TRIPLETS: Final = {"amd64": "x86_64-linux-gnu", "arm64": "aarch64-linux-gnu"}
"""Names of the binutils of an architecture."""
PYTHON: Final = "3.11"
"""Debian 12's: fastcrc is compiled for it."""
PROGRAM: Final = "/usr/bin/swathd"
HOME: Final = Path("usr/lib/swathd")
SYSTEM: Final = {
    "swathd.service": Path("lib/systemd/system/swathd.service"),
    "udev.rules": Path("lib/udev/rules.d/70-swathd.rules"),
    "sysusers.conf": Path("usr/lib/sysusers.d/swathd.conf"),
    "tmpfiles.conf": Path("usr/lib/tmpfiles.d/swathd.conf"),
    "sysctl.conf": Path("usr/lib/sysctl.d/70-swathd.conf"),
    "sshd.conf": Path("etc/ssh/sshd_config.d/60-swathd.conf"),
    # a template: which port is the lidar's only its owner knows, and `swathd install --lidar-interface` puts it in force
    "lidar.network": HOME / "systemd" / "lidar.network",
}
CONFFILES: Final = ("etc/ssh/sshd_config.d/60-swathd.conf", "etc/swathd/swathd.yaml")
DIALECT: Final = (
    "pymavlink/__init__.py",
    "pymavlink/dialects/__init__.py",
    "pymavlink/dialects/v20/__init__.py",
    "pymavlink/dialects/v20/ardupilotmega.py",
)
"""Of pymavlink: what swathd imports."""


def version() -> str:
    """The project's."""
    return str(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"])


def epoch_s() -> int:
    """Time of the sources: SOURCE_DATE_EPOCH, else the last commit's, else now."""
    if given := os.environ.get("SOURCE_DATE_EPOCH"):
        return int(given)
    done = subprocess.run(["git", "log", "-1", "--format=%ct"], cwd=ROOT, capture_output=True, text=True, check=False)
    return int(done.stdout) if done.returncode == 0 and done.stdout.strip() else round(datetime.now(UTC).timestamp())


def wheels(architecture: str, cache: Path) -> list[Path]:
    """The wheels that are carried, fetched by hash where they are not in the cache yet."""
    folder = cache / architecture
    words = [
        "download",
        "--quiet",
        "--disable-pip-version-check",
        "--no-deps",
        "--only-binary=:all:",
        "--require-hashes",
    ]
    platform = ["--platform", PLATFORMS[architecture], "--python-version", PYTHON, "--dest", str(folder)]
    folder.mkdir(parents=True, exist_ok=True)
    lines = [line for line in (DEB / "wheels.txt").read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    found = []
    for line in lines:
        name = line.partition("==")[0]
        if name == "pymavlink":  # pure Python of it is taken: the same file for all
            platform[1], platform[5] = PLATFORMS["amd64"], str(cache / "all")
        else:
            platform[1], platform[5] = PLATFORMS[architecture], str(folder)
        there = list(Path(platform[5]).glob(f"{name}-{line.partition('==')[2].split()[0]}-*.whl"))
        if not there:
            with tempfile.NamedTemporaryFile("w", suffix=".txt") as wanted:
                wanted.write(line + "\n")
                wanted.flush()
                subprocess.run([sys.executable, "-m", "pip", *words, *platform, "-r", wanted.name], check=True)
            there = list(Path(platform[5]).glob(f"{name}-*.whl"))
        found.append(there[0])
    return found


def lay_out(tree: Path, architecture: str, number: str, cache: Path) -> None:
    """Every file of the package, below a folder."""
    import manpages

    from flightlog.config import sample
    from onboard.config import SwathdConfig
    from onboard.install import PROGRAM as NAMED

    for name in ("firmware_config", "flightlog", "onboard"):
        shutil.copytree(ROOT / name, tree / HOME / name, ignore=shutil.ignore_patterns("__pycache__", "py.typed"))
    for wheel in wheels(architecture, cache):
        with zipfile.ZipFile(wheel) as packed:
            for name in packed.namelist():
                if name in DIALECT or (name.startswith("fastcrc/") and not name.endswith((".pyi", "py.typed"))):
                    packed.extract(name, tree / HOME / "vendor")
    for compiled in (tree / HOME / "vendor").rglob("*.so"):
        subprocess.run([f"{TRIPLETS[architecture]}-strip", "--strip-unneeded", str(compiled)], check=True)
    write(
        tree / HOME / f"swath-{number}.dist-info" / "METADATA",
        f"Metadata-Version: 2.1\nName: swath\nVersion: {number}\n",
    )
    for name, place in SYSTEM.items():
        write(tree / place, (ROOT / "systemd" / name).read_text(encoding="utf-8").replace(NAMED, PROGRAM))
    write(tree / "etc/swathd/swathd.yaml", sample(SwathdConfig))
    write(tree / "usr/bin/swathd", (DEB / "swathd").read_text(encoding="utf-8"))
    for section, name, text in (
        (8, "swathd", manpages.program(number)),
        (5, "swathd.yaml", manpages.configuration(number)),
    ):
        write_gz(tree / f"usr/share/man/man{section}/{name}.{section}.gz", text)
    docs = tree / "usr/share/doc/swathd"
    write(docs / "copyright", (DEB / "copyright").read_text(encoding="utf-8"))
    date = format_datetime(datetime.fromtimestamp(epoch_s(), UTC))
    entry = f"swathd ({number}) stable; urgency=medium\n\n  * Release {number}; see CHANGELOG.md.gz.\n\n"
    write_gz(docs / "changelog.gz", f"{entry} -- The swath authors <swath@example.org>  {date}\n")
    write_gz(docs / "CHANGELOG.md.gz", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))


def write(path: Path, text: str) -> None:
    """A file with its folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def write_gz(path: Path, text: str) -> None:
    """A compressed file without a time or a name in it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(text.encode(), 9, mtime=0))


def describe(tree: Path, architecture: str, number: str) -> None:
    """What dpkg wants to know."""
    files = sorted(path for path in tree.rglob("*") if path.is_file())
    size_kb = sum(-(-path.stat().st_size // 1024) for path in files)
    control = (DEB / "control").read_text(encoding="utf-8")
    write(tree / "DEBIAN/control", control.format(version=number, architecture=architecture, installed_kb=size_kb))
    write(tree / "DEBIAN/conffiles", "".join(f"/{name}\n" for name in CONFFILES))
    digests = subprocess.run(
        ["md5sum", "--", *(str(path.relative_to(tree)) for path in files)], cwd=tree, capture_output=True, text=True, check=True
    ).stdout  # fmt: skip
    write(tree / "DEBIAN/md5sums", "".join(line for line in digests.splitlines(True) if "  etc/" not in line))
    for name in ("postinst", "prerm", "postrm"):
        write(tree / "DEBIAN" / name, (DEB / name).read_text(encoding="utf-8"))


def settle(tree: Path) -> None:
    """Modes and times, whatever those of the checkout and of the wheels are."""
    runnable = {tree / "usr/bin/swathd", *(tree / "DEBIAN" / name for name in ("postinst", "prerm", "postrm"))}
    when = epoch_s()
    for path in sorted(tree.rglob("*"), reverse=True):
        path.chmod(0o755 if path.is_dir() or path in runnable else 0o644)
        os.utime(path, (when, when))
    tree.chmod(0o755)
    os.utime(tree, (when, when))


def build(architecture: str, output: Path, number: str, cache: Path) -> Path:
    """Build one package; gives its file."""
    output.mkdir(parents=True, exist_ok=True)
    path = output / f"swathd_{number}_{architecture}.deb"
    with tempfile.TemporaryDirectory(prefix="swathd-deb-") as folder:
        tree = Path(folder) / "tree"
        lay_out(tree, architecture, number, cache)
        describe(tree, architecture, number)
        settle(tree)
        subprocess.run(
            ["dpkg-deb", "--root-owner-group", "-Zxz", "--build", str(tree), str(path)],
            check=True, stdout=subprocess.DEVNULL, env=os.environ | {"SOURCE_DATE_EPOCH": str(epoch_s())},
        )  # fmt: skip
    return path


def main() -> int:
    """Build for the architectures asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("architectures", nargs="*", metavar="ARCHITECTURE", help="amd64, arm64; default: both")
    parser.add_argument("--output", type=Path, default=ROOT / "dist", metavar="DIR", help="default: dist/")
    parser.add_argument(
        "--cache", type=Path, default=ROOT / "build" / "wheels", metavar="DIR", help="default: build/wheels"
    )
    parser.add_argument("--version", default=version(), help="default: that of pyproject.toml")
    arguments = parser.parse_args()
    unknown = set(arguments.architectures) - set(PLATFORMS)
    if unknown:
        parser.error(f"{', '.join(sorted(unknown))}: expected {' or '.join(PLATFORMS)}")
    for architecture in arguments.architectures or PLATFORMS:
        path = build(architecture, arguments.output, arguments.version, arguments.cache)
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
