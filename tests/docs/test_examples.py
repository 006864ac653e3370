"""Command lines that the pages show: the program takes each of them as it stands."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from groundproc.cli import Parser, commands

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
FENCED = re.compile(r"^( *)```(?:sh|bash|console)?\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"^ {4}(swath .*)$", re.MULTILINE)
INLINE = re.compile(r"`(swath [a-z][^`]*)`")


def typed(text: str) -> Iterator[list[str]]:
    """The words of each `swath` line of the blocks of a page, without comment, redirection and `&`."""
    for block in [block for _, block in FENCED.findall(text)] + INDENTED.findall(text):
        for line in block.replace("\\\n", " ").splitlines():
            if line.strip().removeprefix("$ ").startswith("swath "):
                words = shlex.split(line.strip().removeprefix("$ "), comments=True)
                yield re.split(r" [>&|]", shlex.join(words).replace("'>'", ">").replace("'&'", "&"))[0].split(" ")[1:]


def parser_of(name: str) -> Parser:
    parser = Parser(prog=f"swath {name}")
    commands()[name].load().add_arguments(parser)
    return parser


def options_of(parser: Parser) -> set[str]:
    return {option for action in parser._actions for option in action.option_strings}


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_a_page_shows_can_be_typed(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Lines of blocks parse as a whole; what the text mentions is known by its full name."""
    text = page.read_text(encoding="utf-8")
    for words in typed(text):
        parser = parser_of(words[0])
        try:
            parser.parse_args(words[1:])
        except SystemExit:
            pytest.fail(f"swath {' '.join(words)}: {capsys.readouterr().err}")
    mentioned = [line.split()[1:] for line in INLINE.findall(text)]
    for words in [*typed(text), *mentioned]:
        assert words[0] in commands(), words
        known = options_of(parser_of(words[0]))
        assert {word.partition("=")[0] for word in words if word.startswith("--")} <= known, words
