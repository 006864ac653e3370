"""A verdict on a log or a flight: good, doubtful or bad, with the reasons, from the figures that are there anyway.

A rule looks at figures and gives its reasons; those in `log` judge what `swath info` found, those in `flight` what stands in quality.json.
Whatever says `warning` or `warnings` anywhere in the figures is a reason too, so that who finds something new need only write it there.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Self

GOOD: Final = "good"
DOUBTFUL: Final = "doubtful"
BAD: Final = "bad"
GRADES: Final = (GOOD, DOUBTFUL, BAD)
"""From best to worst."""
EXIT_CODES: Final = {GOOD: 0, DOUBTFUL: 3, BAD: 1}


@dataclass(frozen=True, slots=True)
class Reason:
    """One thing that is not as it should be.

    Attributes
    ----------
    grade : str
        What it makes of the whole: `DOUBTFUL` or `BAD`.
    about : str
        One word for programs, such as "truncated".
    text : str
        For people: what was found, what was expected, what helps.
    """

    grade: str
    about: str
    text: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """The worst of all reasons, and all of them."""

    reasons: tuple[Reason, ...] = ()

    @property
    def grade(self) -> str:
        """One of `GRADES`."""
        return max((reason.grade for reason in self.reasons), key=GRADES.index, default=GOOD)

    @property
    def exit_code(self) -> int:
        """Of the program that gives it."""
        return EXIT_CODES[self.grade]

    def line(self) -> str:
        """The one line that a person reads; the worst comes first."""
        ordered = sorted(self.reasons, key=lambda reason: -GRADES.index(reason.grade))
        return f"verdict: {self.grade}" + "".join(
            f"{': ' if i == 0 else '; '}{reason.text}" for i, reason in enumerate(ordered)
        )

    def to_mapping(self) -> dict[str, Any]:
        """For JSON: the grade, and the reasons beside it."""
        return {"verdict": self.grade, "verdict_reasons": [asdict(reason) for reason in self.reasons]}

    @classmethod
    def from_mapping(cls, tree: Mapping[str, Any]) -> Self:
        """What `to_mapping` gave."""
        return cls(tuple(Reason(**reason) for reason in tree["verdict_reasons"]))


Figures = Mapping[str, Any]
Rule = Callable[[Figures], Iterator[Reason]]


def judge(figures: Figures, rules: Sequence[Rule]) -> Verdict:
    """What the rules say, and every warning in the figures."""
    found = [reason for rule in rules for reason in rule(figures)]
    found += [Reason(DOUBTFUL, "warning", text) for text in warnings_in(figures)]
    return Verdict(tuple(dict.fromkeys(found)))


def warnings_in(figures: Any) -> list[str]:
    """Every text under a key `warning` or `warnings`, however deep, each once."""
    found: list[str] = []
    if isinstance(figures, Mapping):
        for key, value in figures.items():
            if key in ("warning", "warnings"):
                found += [text for text in ([value] if isinstance(value, str) else value or ()) if text]
            else:
                found += warnings_in(value)
    elif isinstance(figures, list | tuple):
        found += [text for each in figures for text in warnings_in(each)]
    return list(dict.fromkeys(found))


def share(part: float, whole: float) -> float:
    """A part of the whole; nothing of nothing is 0."""
    return part / whole if whole > 0 else 0.0


def percent(share: float) -> str:
    """In words, small ones with a decimal."""
    return f"{share:.0%}" if share >= 0.1 else f"{share:.1%}"
