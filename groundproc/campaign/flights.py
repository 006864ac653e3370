"""flights.yaml: the flights of a campaign, the settings that they share, and where their products go."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from flightlog import config
from flightlog.config import option
from flightlog.errors import ConfigError
from groundproc.campaign.places import beside
from groundproc.survey import FILES, Survey

_NAME: Final = re.compile(r"[^\W_][\w.-]*")


@dataclass(frozen=True, slots=True)
class Flight:
    """One flight.

    Attributes
    ----------
    name : str
        Of its folder below `output`.
    logs : tuple of str
        All parts of the flight: after a change of battery these are several.
    survey : dict
        Settings of this flight, over those of the campaign.
    """

    name: str = option("", "name of the flight's folder below output")
    logs: tuple[str, ...] = option((), "its logs: several where the battery was changed")
    survey: Any = option(None, "settings of this flight, over those of the campaign: keys of a survey.yaml")


@dataclass(frozen=True, slots=True)
class Campaign:
    """What flights.yaml holds.

    Attributes
    ----------
    output : str
        A folder, or any place that fsspec knows, such as s3://bucket/prefix.
    survey : str, dict or None
        A survey.yaml for all flights, or its keys and values.
    flights : tuple of Flight
    """

    output: str = option("", "folder of the products, or s3://bucket/prefix or any other place that fsspec knows")
    survey: Any = option(None, "settings of all flights: a survey.yaml, or what stands in one")
    flights: tuple[Flight, ...] = option((), "the flights")


@dataclass(frozen=True, slots=True)
class Job:
    """What is to be done for one flight, in words that another computer understands.

    Attributes
    ----------
    name : str
    logs : tuple of str
    settings : str
        YAML of the whole survey.
    output : str
        Of this flight.
    force : bool
    """

    name: str
    logs: tuple[str, ...]
    settings: str
    output: str
    force: bool = False


def load_jobs(path: Path, force: bool) -> list[Job]:
    """Read flights.yaml; files are looked for beside it.

    Raises
    ------
    ConfigError
        It is not one, or two flights have one name, or a setting is none.
    """
    campaign = config.load(path, Campaign)
    if not campaign.output or not campaign.flights:
        raise ConfigError(f"{path}: {'output' if not campaign.output else 'flights'} is missing")
    common = _settings(campaign.survey, path, f"{path}: survey")
    jobs: dict[str, Job] = {}
    for number, flight in enumerate(campaign.flights):
        place = f"{path}: flights[{number}]"
        if not _NAME.fullmatch(flight.name):
            raise ConfigError(
                f"{place}: name is {flight.name!r}, expected letters, digits, dots, hyphens and underscores"
            )
        if flight.name in jobs:
            raise ConfigError(
                f"{place}: name {flight.name!r} is that of another flight too; each has a folder of its own"
            )
        if not flight.logs:
            raise ConfigError(f"{place}: logs is missing: the logs of flight {flight.name}")
        survey = config.from_mapping(
            common | _settings(flight.survey, path, f"{place}: survey"), Survey, f"{place}: survey"
        )
        jobs[flight.name] = Job(
            flight.name,
            tuple(beside(path, log) for log in flight.logs),
            config.dump(survey),
            f"{beside(path, campaign.output).rstrip('/')}/{flight.name}",
            force,
        )
    return list(jobs.values())


def _settings(given: Any, path: Path, place: str) -> dict[str, Any]:
    """Keys and values of a survey, its files named so that they are found from everywhere."""
    if given is None:
        return {}
    base = path
    if isinstance(given, str):
        base = Path(beside(path, given))
        given = config.load_tree(base)
    if not isinstance(given, dict):
        raise ConfigError(f"{place}: {given!r} found, expected the name of a survey.yaml, or keys and values")
    return {
        key: beside(base, value) if key in FILES and isinstance(value, str) and value != "estimate" else value
        for key, value in given.items()
    }
