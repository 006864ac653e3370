"""The report on paper: printed by Chromium, which shows the cloud too, or by weasyprint."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Final

from flightlog.errors import SourceError, UsageError

BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_PATIENCE_S: Final = 180
_FLAGS: Final = (
    "--headless=new", "--disable-dev-shm-usage", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-extensions", "--disable-background-networking", "--no-first-run", "--no-pdf-header-footer",
    "--virtual-time-budget=20000",
)  # fmt: skip


def print_pdf(page: Path, out: Path) -> None:
    """Write a page as PDF.

    Raises
    ------
    UsageError
        Neither program is there.
    SourceError
        It fails.
    """
    program = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if program is not None:
        _by_browser(program, page, out)
    else:
        _by_weasyprint(page, out)


def _by_browser(program: str, page: Path, out: Path) -> None:
    with tempfile.TemporaryDirectory(prefix="swath-print-") as folder:
        # of no use, and refused, where root runs it; the page is ours and lets nothing in
        own = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
        command = [
            program, *_FLAGS, *own, f"--user-data-dir={folder}/profile", f"--print-to-pdf={out.resolve()}",
            page.resolve().as_uri(),
        ]  # fmt: skip
        try:
            done = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                timeout=_PATIENCE_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise SourceError(f"{out.name}: {program} has not printed it in {_PATIENCE_S} s") from None
        except OSError as error:
            raise SourceError(f"{out.name}: {program} cannot be run ({error.strerror or error})") from None
        if done.returncode or not out.is_file() or not out.stat().st_size:
            lines = done.stderr.decode("utf-8", "replace").split("\n")
            said = next((line.strip() for line in reversed(lines) if line.strip()), "nothing")
            raise SourceError(
                f"{out.name}: {program} did not print it (exit code {done.returncode}, it said: {said[:200]})"
            )


def _by_weasyprint(page: Path, out: Path) -> None:
    try:
        from weasyprint import HTML
    except (ImportError, OSError):  # its libraries may be missing too
        raise UsageError(
            f"{out.name}: to print the report, Chromium (`apt-get install chromium`) or weasyprint (`pip install 'swath[pdf]'`) is "
            "needed, and neither is here; any browser prints report.html as well"
        ) from None
    HTML(filename=str(page)).write_pdf(str(out))
