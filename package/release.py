"""Builds all that a release consists of into one folder: wheel, sdist, Debian packages, notes, SBOM and checksums. Publishes nothing.

The version is pyproject.toml's, and stands nowhere else. Times in the files are those of the last commit.
"""

import argparse
import hashlib
import os
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any, Final

from packaging.requirements import Requirement

sys.path.insert(0, str(Path(__file__).resolve().parent))

import deb

ROOT: Final = deb.ROOT
SUMS: Final = "SHA256SUMS"
UNRELEASED: Final = "Unreleased"


def notes(changelog: str, version: str) -> tuple[str, bool]:
    """The section of a version in the changelog, and whether there is one; else what is not released yet.

    Raises
    ------
    ValueError
        It has neither.
    """
    sections: dict[str, list[str]] = {}
    name = ""
    for line in changelog.splitlines():
        if line.startswith("## "):
            name = line[3:].split()[0]
            sections[name] = []
        elif name:
            sections[name].append(line)
    for wanted in (version, UNRELEASED):
        if wanted in sections:
            return "\n".join(sections[wanted]).strip() + "\n", wanted == version
    raise ValueError(f"CHANGELOG.md: has neither a section {version} nor {UNRELEASED}")


def carried() -> list[tuple[str, str, list[str]]]:
    """Name, version and hashes of the wheels that the Debian packages carry."""
    found = []
    for line in (deb.DEB / "wheels.txt").read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            requirement, *hashes = line.split()
            name, _, number = requirement.partition("==")
            found.append((name, number, [each.partition("sha256:")[2] for each in hashes]))
    return found


def required(project: dict[str, Any]) -> list[tuple[str, str | None, str]]:
    """Name, version here (None: not installed), and which extra asks for it, of every library that is used."""
    wanted = {"": project["dependencies"], **project["optional-dependencies"]}
    found: dict[str, tuple[str | None, str]] = {}
    for extra, requirements in wanted.items():
        if extra in ("dev", "mutations"):
            continue
        for text in requirements:
            name = Requirement(text).name
            try:
                number: str | None = installed(name)
            except PackageNotFoundError:
                number = None
            found.setdefault(name, (number, extra))
    return [(name, number, extra) for name, (number, extra) in sorted(found.items())]


def sbom(project: dict[str, Any]) -> str:
    """A bill of materials, CycloneDX 1.6: what the project needs, at the versions that it was tested with, and what packages carry."""
    from cyclonedx.model import HashAlgorithm, HashType, Property
    from cyclonedx.model.bom import Bom
    from cyclonedx.model.component import Component, ComponentScope, ComponentType
    from cyclonedx.output.json import JsonV1Dot6
    from packageurl import PackageURL

    version = project["version"]
    whole = Component(name="swath", version=version, type=ComponentType.APPLICATION, bom_ref=f"swath@{version}")
    bom = Bom()
    bom.metadata.component = whole
    parts = []
    for name, number, extra in required(project):
        parts.append(
            Component(
                name=name,
                version=number,
                type=ComponentType.LIBRARY,
                bom_ref=f"{name}@{number}",
                purl=PackageURL("pypi", name=name.lower(), version=number),
                scope=ComponentScope.OPTIONAL if extra else ComponentScope.REQUIRED,
                properties=[Property(name="swath:extra", value=extra or "none")],
            )
        )
    for name, number, hashes in carried():
        parts.append(
            Component(
                name=name,
                version=number,
                type=ComponentType.LIBRARY,
                bom_ref=f"swathd.deb/{name}@{number}",
                purl=PackageURL("pypi", name=name, version=number),
                hashes=[HashType(alg=HashAlgorithm.SHA_256, content=each) for each in hashes],
                properties=[Property(name="swath:carried-by", value="swathd.deb")],
            )
        )
    for part in parts:
        bom.components.add(part)
    bom.register_dependency(whole, parts)
    return JsonV1Dot6(bom).output_as_string(indent=1) + "\n"


def sums(folder: Path) -> str:
    """Lines as sha256sum writes and checks them."""
    files = sorted(path for path in folder.iterdir() if path.is_file() and path.name != SUMS)
    return "".join(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in files)


def build(output: Path, cache: Path) -> Path:
    """Build everything; gives the folder."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    version = project["version"]
    text, named = notes((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), version)
    if not named:
        print(f"CHANGELOG.md has no section {version}: the notes are those of {UNRELEASED}", file=sys.stderr)
    folder = output / version
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    surroundings = os.environ | {"SOURCE_DATE_EPOCH": str(deb.epoch_s())}
    words = [sys.executable, "-m", "build", "--outdir", str(folder), str(ROOT)]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL, env=surroundings)
    for architecture in deb.PLATFORMS:
        deb.build(architecture, folder, version, cache)
    (folder / "NOTES.md").write_text(text, encoding="utf-8")
    (folder / "swath.cdx.json").write_text(sbom(project), encoding="utf-8")
    (folder / SUMS).write_text(sums(folder), encoding="utf-8")
    return folder


def main() -> int:
    """Build, and say what was built."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--output", type=Path, default=ROOT / "dist", metavar="DIR", help="default: dist/")
    parser.add_argument(
        "--cache", type=Path, default=ROOT / "build" / "wheels", metavar="DIR", help="default: build/wheels"
    )
    arguments = parser.parse_args()
    folder = build(arguments.output, arguments.cache)
    print((folder / SUMS).read_text(encoding="utf-8"), end="")
    print(f"in {folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
