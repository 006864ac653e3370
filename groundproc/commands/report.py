"""`swath report`: report.html of a finished folder made again, and as PDF."""

import argparse
from pathlib import Path

HELP = "make the report of a processed flight again, and print it as PDF"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument("folder", type=Path, metavar="DIR", help="a folder of `swath process`; its logs are not needed")
    parser.add_argument("--pdf", action="store_true", help="print it to report.pdf as well, by Chromium or weasyprint")
    parser.add_argument("--force", action="store_true", help="write over a report that was changed since")


def run(arguments: argparse.Namespace) -> int:
    """Make it; nothing else in the folder is touched."""
    from groundproc.commands.inputs import expect
    from groundproc.products.report import FILE
    from groundproc.reporting.pdf import print_pdf
    from groundproc.steps.again import again

    folder: Path = arguments.folder
    expect([folder], ("products", "folder"), "a folder of `swath process`")
    pdf = Path(FILE).with_suffix(".pdf").name

    def after(made: Path) -> None:
        if arguments.pdf:
            print_pdf(made / FILE, made / pdf)

    again(folder, FILE, after, arguments.force)
    print(f"look at {folder / FILE}" + (f" and {folder / pdf}" if arguments.pdf else ""))
    return 0
