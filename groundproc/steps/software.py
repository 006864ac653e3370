"""Which software made something: the version, and a hash of the source, so that in a checkout every change of it counts."""

import hashlib
from functools import cache
from pathlib import Path

import firmware_config
import flightlog
import groundproc


@cache
def version() -> str:
    """Such as 0.1.0+3f9a0c12."""
    digest = hashlib.sha256()
    for package, kind in ((flightlog, "*.py"), (groundproc, "*.py"), (firmware_config, "*.yaml")):
        root = Path(package.__path__[0])
        for path in sorted(root.rglob(kind)):
            digest.update(f"{path.relative_to(root)} {path.stat().st_size}\n".encode())
            digest.update(path.read_bytes())
    return f"{flightlog.__version__}+{digest.hexdigest()[:8]}"
