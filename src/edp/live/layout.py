"""Columns of a live session, and their presentation on a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from edp.signals import KINDS, Channel, display_offset

MOST_LABEL = 80
"""Maximum number of characters of a name on the page."""


@dataclass(frozen=True)
class LiveTrace:
    """One column of measured values.

    Attributes:
        name: name as plain text, without markup.
        unit: displayed unit.
        factor: factor from SI to the displayed unit.
        offset: added behind the factor.
        description: description in words.
    """

    name: str
    unit: str
    factor: float = 1.0
    offset: float = 0.0
    description: str = ""

    @staticmethod
    def from_channel(channel: Channel) -> LiveTrace:
        """Create the trace of a channel in report units."""
        facts = KINDS[channel.kind]
        return LiveTrace(
            label(channel.name), facts.report_unit, facts.report_factor, facts.report_offset, label(channel.description)
        )


@dataclass(frozen=True)
class Forecast:
    """A prediction, made at a tick for `ticks` later, with its interval.

    Attributes:
        name: name of the predicted channel.
        unit: see `LiveTrace`; `factor` likewise.
        factor: factor from SI to the displayed unit.
        ticks: horizon in samples; 0 for the present sample.
        column: column of the prediction.
        lower: column of the interval's lower bound, None without one; `upper` likewise.
        upper: see `lower`.
        coverage: share that the interval is meant to hold.
        measured: column of what then happened, None where nothing measures it.
        model: name of the model.
    """

    name: str
    unit: str
    factor: float
    ticks: int
    column: int
    lower: int | None = None
    upper: int | None = None
    coverage: float | None = None
    measured: int | None = None
    model: str = "network"

    @property
    def offset(self) -> float:
        """Added behind the factor."""
        return display_offset(self.unit)


@dataclass(frozen=True)
class LiveLayout:
    """Columns of a session, and the data that a page needs to show them.

    Attributes:
        title: title of the page.
        source: source of the rows, in words.
        rate_hz: sampling rate in Hz.
        width: number of columns.
        traces: traces of the first columns, in order.
        forecasts: predictions in the remaining columns.
        geometry: machine geometry for the side view; None without one.
        angles: columns of the joint angles (rad) of boom, arm and bucket; empty without a side view.
        levers: columns that an operator or controller commands.
        statistics: columns of a monitor's statistics over their limit, by name; an alarm is raised above 1.
        steered: whether viewers may pause the source, change its speed and let it run ahead.
        ticks: length of the source in samples, if known.
    """

    title: str
    source: str
    rate_hz: float
    width: int
    traces: Sequence[LiveTrace]
    forecasts: Sequence[Forecast] = ()
    geometry: Mapping[str, object] | None = None
    angles: Sequence[int] = ()
    levers: Sequence[int] = ()
    statistics: Mapping[str, int] | None = None
    steered: bool = False
    ticks: int | None = None

    def to_dict(self) -> dict[str, object]:
        """Return the plain JSON values, keys as the fields."""
        plain = asdict(self)
        for entry, forecast in zip(plain["forecasts"], self.forecasts, strict=True):
            entry["offset"] = forecast.offset
        plain["statistics"] = [{"name": label(name), "column": n} for name, n in (self.statistics or {}).items()]
        return plain


def sentence(text: str) -> str:
    """Replace invisible characters, which could change the text direction or move a cursor."""
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)


def label(text: str) -> str:
    """Return a text from a file or sender for a page: limited length, invisible characters replaced."""
    visible = sentence(text[: MOST_LABEL + 1])
    # The end is kept: names of one machine often begin alike.
    return visible if len(visible) <= MOST_LABEL else f"{visible[: MOST_LABEL - 32]}…{sentence(text[-31:])}"
