"""What a release consists of."""

import importlib
import json
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def release() -> ModuleType:
    sys.path.insert(0, str(ROOT / "package"))
    try:
        return importlib.import_module("release")
    finally:
        sys.path.remove(str(ROOT / "package"))


def test_the_version_stands_in_one_place() -> None:
    from flightlog import __version__

    assert __version__ == PROJECT["version"]
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout.decode()
    sources = [
        name for name in tracked.split("\x00") if name.endswith((".py", ".service", ".conf", "Makefile", "control"))
    ]
    stated = re.compile(rf"""version["']?\s*[=:]\s*["']{re.escape(PROJECT["version"])}["']""", re.IGNORECASE)
    assert [name for name in sources if stated.search((ROOT / name).read_text())] == []


def test_notes_are_the_section_of_the_version_or_what_is_not_released_yet(release: ModuleType) -> None:
    text = "# Changelog\n\n## Unreleased\n\n- new\n\n## 0.2.0 (2026-05-01)\n\n- two\n\n### Aboard\n\n- more\n\n## 0.1.0\n\n- one\n"
    assert release.notes(text, "0.2.0") == ("- two\n\n### Aboard\n\n- more\n", True)
    assert release.notes(text, "0.1.0") == ("- one\n", True)
    assert release.notes(text, "0.3.0") == ("- new\n", False)
    with pytest.raises(ValueError, match="neither"):
        release.notes("# Changelog\n", "0.1.0")
    assert release.notes((ROOT / "CHANGELOG.md").read_text(), PROJECT["version"])[0].strip()


def test_the_bill_of_materials_is_one_by_its_standard_and_whole(release: ModuleType) -> None:
    from cyclonedx.schema import SchemaVersion
    from cyclonedx.validation.json import JsonStrictValidator

    text = release.sbom(PROJECT)
    assert JsonStrictValidator(SchemaVersion.V1_6).validate_str(text) is None
    parts = json.loads(text)["components"]
    names = {part["name"].lower() for part in parts}
    assert {"numpy", "pymavlink", "fastcrc", "laspy", "pyproj", "numba"} <= names
    assert not names & {"pytest", "ruff", "mypy", "swath"}
    in_deb = [part for part in parts if any(each["value"] == "swathd.deb" for each in part["properties"])]
    assert {part["name"]: len(part["hashes"]) for part in in_deb} == {"pymavlink": 1, "fastcrc": 2}
    assert json.loads(text)["metadata"]["component"]["version"] == PROJECT["version"]


# everything that is published is built
@pytest.mark.soak
def test_a_release_is_whole_and_its_checksums_hold(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, ROOT / "package" / "release.py", "--output", tmp_path],
        capture_output=True,
        text=True,
        check=False,
    )
    if any(word in done.stderr for word in ("No matching distribution", "Could not fetch", "Connection", "ProxyError")):
        pytest.skip("pip reaches no package index")
    assert done.returncode == 0, done.stderr[-2000:]
    version = PROJECT["version"]
    folder = tmp_path / version
    names = {path.name for path in folder.iterdir()}
    assert names == {
        f"swath-{version}-py3-none-any.whl", f"swath-{version}.tar.gz", f"swathd_{version}_amd64.deb",
        f"swathd_{version}_arm64.deb", "NOTES.md", "SHA256SUMS", "swath.cdx.json",
    }  # fmt: skip
    subprocess.run(["sha256sum", "--check", "--strict", "SHA256SUMS"], cwd=folder, check=True, capture_output=True)
    assert len((folder / "SHA256SUMS").read_text().splitlines()) == len(names) - 1
    with zipfile.ZipFile(folder / f"swath-{version}-py3-none-any.whl") as wheel:
        assert {name.partition("/")[0] for name in wheel.namelist()} >= {
            "flightlog",
            "onboard",
            "groundproc",
            "simulator",
        }
    with tarfile.open(folder / f"swath-{version}.tar.gz") as source:
        assert f"swath-{version}/pyproject.toml" in source.getnames()
