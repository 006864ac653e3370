"""HTML put together so that no word of a file becomes part of it: text is escaped unless it is `Html` already."""

import html
from collections.abc import Iterable, Sequence


class Html(str):
    """Text that is HTML."""

    __slots__ = ()


Child = str | Iterable["Child"]


def tag(name: str, *inside: Child, **attributes: str | float | None) -> Html:
    """An element; `class_` is the attribute `class`, underscores are hyphens, None leaves an attribute out."""
    words = [name]
    for key, value in attributes.items():
        if value is not None:
            text = f"{value:g}" if isinstance(value, float) else str(value)
            words.append(f'{key.rstrip("_").replace("_", "-")}="{html.escape(text)}"')
    return Html(f"<{' '.join(words)}>{joined(inside)}</{name}>")


def joined(inside: Iterable[Child]) -> Html:
    """Some text and elements, one after the other."""
    parts: list[str] = []
    for each in inside:
        if isinstance(each, Html):
            parts.append(each)
        elif isinstance(each, str):
            parts.append(html.escape(each))
        else:
            parts.append(joined(each))
    return Html("".join(parts))


def table(head: Sequence[str], rows: Iterable[Sequence[str]], class_: str = "") -> Html:
    """A table; the first cell of a row is what the others are of."""
    lines = [tag("tr", tag("th", row[0], scope="row"), [tag("td", cell) for cell in row[1:]]) for row in rows]
    top = tag("thead", tag("tr", [tag("th", name, scope="col") for name in head])) if head else Html("")
    return tag("div", tag("table", top, tag("tbody", lines), class_=class_ or None), class_="scroll")


def section(name: str, title: str, *inside: Child) -> Html:
    """A part of the page."""
    return tag("section", tag("h2", title), *inside, id=name)
