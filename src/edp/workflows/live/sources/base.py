"""Source of a live session's rows: registry and common parts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError
from edp.logs.source import load_signal_map
from edp.recording import Recording
from edp.registry import Registry
from edp.settings.bounds import check_bounds, span
from edp.signals import Channel, SignalMap
from edp.storage.reading import Table

Row = NDArray[np.float32]
RATES_HZ = (0.01, 100_000.0)
"""Lowest and highest rate of a live source."""


class SourceStopped(Exception):
    """Signal that the session is over; a source lets it pass."""


class Sink(Protocol):
    """Receiver of a source's rows."""

    @property
    def stopped(self) -> bool:
        """Whether the session is over."""
        ...

    def take(self, row: Row, missed: int = 0, trusted: bool = True, more: bool = False) -> None:
        """Take a row, shape (channels,), SI units, NaN if missing; returns when the next one is due.

        Args:
            row: row of the source's channels.
            missed: ticks that went by without a row before this one.
            trusted: whether rows come at the models' rate; they predict nothing where they do not.
            more: whether a further row waits already, of a source that cannot be steered; both are then shown at once.

        Raises:
            SourceStopped: the session is over.
        """
        ...

    def show(self) -> None:
        """Show the rows until now: the next one is late."""
        ...

    def begin_anew(self) -> None:
        """Start again: the next row does not continue the last one, and models forget."""
        ...

    def leave_out(self, reason: str) -> None:
        """Count an unusable row; report the reason for the first rows, then for every thousandth row."""
        ...

    def note(self, kind: str, text: str, group: str = "") -> None:
        """Report an event, see `edp.live.session.LiveEvent`."""
        ...


@dataclass(frozen=True)
class SourceOptions:
    """Options of a source from the user.

    Attributes:
        value: value of the source's option: a path, a machine, a task or a port.
        map_file: signal map.
        machine: name or file, where it is not that of the source.
        seed: random seed; None for the default of the source.
        rate_hz: sample rate for a source without its own; None for the rate of the model.
        settings: further values by name, as a source's `of` explains.
    """

    value: str
    map_file: Path | None = None
    machine: str | None = None
    seed: int | None = None
    rate_hz: float | None = None
    settings: Table = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_bounds("the live source", self, rate_hz=span(*RATES_HZ))

    def signal_map(self) -> SignalMap | None:
        """Return the signal map of the file."""
        return None if self.map_file is None else load_signal_map(self.map_file)


@dataclass(frozen=True)
class Needs:
    """Channels and rate that models read.

    Attributes:
        channels: channels of all models, without duplicates.
        rate_hz: sample rate of their training; None without a model.
        twin: channels of a twin among them.
    """

    channels: Sequence[Channel] = ()
    rate_hz: float | None = None
    twin: TwinChannels | None = None


class LiveSource(ABC):
    """Rows of channels at a rate.

    Attributes:
        steered: whether it can be paused and run at another speed.
        options: command-line options that apply to this source, without dashes.
        preparing: description of the work before the first row; empty if it takes no time.
        channels: channels of a row, in order, SI units.
        rate_hz: rows a second.
        text: description in words.
        ticks: number of rows; None if unknown.
        machine: name or file of a machine for the side view, None without one.
        recording: played recording; None without one.
        ending: message at the end of the rows.
    """

    steered: ClassVar[bool] = True
    options: ClassVar[frozenset[str]] = frozenset()
    preparing: ClassVar[str] = ""
    channels: tuple[Channel, ...]
    rate_hz: float
    text: str
    ticks: int | None = None
    machine: str | None = None
    recording: Recording | None = None
    ending: str = "the source has ended"

    @classmethod
    @abstractmethod
    def from_options(cls, options: SourceOptions, needs: Needs) -> LiveSource:
        """Return the source of the user's options.

        Raises:
            EdpError: there is none, or it does not give what the models read.
        """

    def prepare(self) -> None:  # noqa: B027  most sources need nothing
        """Do what would otherwise delay the second row, such as compiling."""

    @abstractmethod
    def run(self, sink: Sink) -> None:
        """Give all rows.

        Raises:
            EdpError: it cannot go on.
            SourceStopped: the session is over.
        """

    def close(self) -> None:  # noqa: B027  most sources hold nothing open
        """Release opened resources."""


SOURCES: Registry[type[LiveSource]] = Registry("live source")
"""Sources by the name of their option."""


def choose_rate(options: SourceOptions, needs: Needs, what: str) -> float:
    """Return the rate of a source that takes it from the models.

    Raises:
        ConfigError: nobody says it.
    """
    rate = options.rate_hz or needs.rate_hz
    if rate is None:
        raise ConfigError(f"{what} does not say its rate, and no model is given that has one; give --rate in Hz")
    return rate


def check_options(source: str, names: Iterable[str]) -> None:
    """Refuse options that do not apply to a source.

    Args:
        source: name of the source.
        names: options that the user gave, without dashes; those that belong to no source are not looked at.

    Raises:
        ConfigError: an option belongs to other sources.
    """
    for name in names:
        owners = [f"--{one}" for one, kind in SOURCES.items() if name in kind.options]
        if owners and name not in SOURCES[source].options:
            raise ConfigError(
                f"--{name} does not apply to --{source}; it belongs to {' and '.join(owners)}: leave it out, or choose "
                "another source"
            )
