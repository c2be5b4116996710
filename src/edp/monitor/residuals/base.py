"""Interface of residual sources: raw channels in sample by sample, measured minus expected out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.progress import SILENT, Progress
from edp.recording import Recording
from edp.registry import Registry
from edp.signals import Channel
from edp.storage.arrays import ArrayRule, checked_arrays
from edp.training.bundle import Bundle
from edp.training.twin_bundle import TwinBundle

Rows = NDArray[np.float32]
MAX_RESIDUALS = 512
"""Maximum number of residuals per source. Machines with more channels must be monitored in parts."""
MIDDLE = ArrayRule(("inputs",), np.float32)
"""Array rule for the substitutes of missing channels, which each source has."""
SISTERS = 11
"""Seed component that separates randomly drawn machines from other random draws."""


@dataclass(frozen=True, eq=False)
class FitMaterial:
    """Data for fitting residuals.

    Attributes:
        train: healthy sessions, all with `channels` at `rate_hz`.
        validation: further ones, for the choice among fits.
        channels: monitored channels, in the order of the monitor's inputs.
        rate_hz: sampling rate in Hz.
        predictors: look-ahead networks of this machine.
        twins: plant models of this machine.
        groups: names of channels that are evaluated together; empty where names and kinds are to tell.
        seed: root of every random choice.
        minutes: processor time that fits may take, all together.
        progress: receiver of what begins.
    """

    train: Sequence[Recording]
    validation: Sequence[Recording]
    channels: tuple[Channel, ...]
    rate_hz: float
    predictors: tuple[Bundle, ...] = ()
    twins: tuple[TwinBundle, ...] = ()
    groups: tuple[tuple[str, ...], ...] = ()
    seed: int = 0
    minutes: float = 8.0
    progress: Progress = SILENT

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return tuple(channel.name for channel in self.channels)


@dataclass(frozen=True, eq=False)
class SourceParts:
    """Serialised source: plain values, arrays, and its networks.

    Attributes:
        plain: JSON values.
        arrays: numbers by name.
        bundles: networks by name; twins are `TwinBundle`.
    """

    plain: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    bundles: Mapping[str, Bundle | TwinBundle] = field(default_factory=dict)


@dataclass
class SourceState:
    """All that a source remembers of `streams` machines.

    Attributes:
        last: the last value of each input that was there, shape (streams, inputs).
        ever: whether there was one, shape (streams, inputs).
        own: state of the source itself.
    """

    last: Rows
    ever: NDArray[np.bool_]
    own: Any


class ResidualSource(ABC):
    """A fitted source.

    State is explicit: ticks, chunks and one call over everything give the same numbers. A missing input (NaN or
    infinite) silences the residuals that evaluate or read it at its ticks, and for what is read the last value that was
    there stands in, so that it never spoils the memory.

    Attributes:
        names: name of each residual, such as ``virtual:CylVels_1``.
        judged: channels whose fault shows as a bias of each residual.
        reads: all inputs that each residual depends on, those that are evaluated among them.
        units: SI unit of each residual.
        inputs: raw channels, SI units.
        middle: substitute for an input that has not been received yet, shape (inputs,).
        delay: ticks after which an offset of a evaluated channel shows at the latest.
    """

    names: tuple[str, ...]
    judged: tuple[tuple[str, ...], ...]
    reads: tuple[tuple[str, ...], ...]
    units: tuple[str, ...]
    inputs: tuple[str, ...]
    middle: Rows
    delay: int = 0

    def initial_state(self, streams: int) -> SourceState:
        """State at the start of `streams` machines."""
        last = np.broadcast_to(self.middle, (streams, len(self.inputs))).astype(np.float32)
        return SourceState(last, np.zeros((streams, len(self.inputs)), dtype=bool), self._start(streams))

    def run(self, rows: Rows, state: SourceState) -> tuple[Rows, SourceState]:
        """Return the residuals of a segment.

        Args:
            rows: raw inputs in SI units, shape (streams, ticks, inputs); NaN marks what is missing.
            state: before it.

        Returns:
            Measured less expected in SI units, shape (streams, ticks, residuals), NaN where not available; and the
            state behind it.

        Raises:
            DataError: rows of another shape.
        """
        rows = np.asarray(rows, dtype=np.float32)
        expected = (len(state.last), len(self.inputs))
        if rows.ndim != 3 or (rows.shape[0], rows.shape[2]) != expected:
            raise DataError(f"rows of shape {rows.shape}; shape ({expected[0]}, ticks, {expected[1]}) must hold")
        if not rows.shape[1]:
            return np.empty((*rows.shape[:2], len(self.names)), np.float32), state
        there = np.isfinite(rows)
        filled, last = self._fill_missing(rows, there, state)
        residuals, own = self._run(filled, there, state.own)
        # A fresh array: sources may give views of what they keep.
        residuals = np.array(residuals, dtype=np.float32)
        if not there.all():
            gone = (~there).astype(np.float32) @ self._read_by.astype(np.float32)
            residuals[gone > 0.0] = np.nan
        return residuals, SourceState(last, state.ever | there.any(axis=1), own)

    @property
    def _read_by(self) -> NDArray[np.bool_]:
        """Return a mask of the inputs read by each residual, shape (inputs, residuals)."""
        return np.array([[name in reads for reads in self.reads] for name in self.inputs]).reshape(
            len(self.inputs), len(self.names)
        )

    @staticmethod
    def _fill_missing(rows: Rows, there: NDArray[np.bool_], state: SourceState) -> tuple[Rows, Rows]:
        """Return rows with missing values replaced by the last value, and the last values."""
        if there.all():
            return rows, rows[:, -1].copy()
        ticks = np.arange(1, rows.shape[1] + 1)[None, :, None]
        # The newest tick that has a value, 0 for none in this stretch.
        newest = np.maximum.accumulate(np.where(there, ticks, 0), axis=1)
        padded = np.concatenate([state.last[:, None], rows], axis=1)
        filled = np.take_along_axis(padded, newest, axis=1)
        return filled, filled[:, -1].copy()

    def adjust_to_sister(self, rng: np.random.Generator, tolerance: float) -> ResidualSource:
        """Return the source adjusted as if for another machine of the series.

        Unchanged if it has no machine parameters.

        Args:
            rng: draws that machine.
            tolerance: share by which each of its numbers may lie off, evenly.
        """
        return self

    def unlearned(self, recording: Recording) -> str:
        """Return why it is silent in a part of a recording that healthy logs do not cover; empty where it is not."""
        return ""

    @abstractmethod
    def _start(self, streams: int) -> Any:
        """Return the initial state of the source."""

    @abstractmethod
    def _run(self, rows: Rows, there: NDArray[np.bool_], own: Any) -> tuple[Rows, Any]:
        """Compute `run` on finite rows; `there` marks measured values, the others were held."""

    @abstractmethod
    def parts(self) -> SourceParts:
        """Return everything to be stored."""

    @classmethod
    @abstractmethod
    def from_parts(cls, parts: SourceParts) -> ResidualSource:
        """Create the source from the result of `parts`.

        Raises:
            ValueError: values that cannot be; files are data from outside.
        """


class ResidualSpec(ABC):
    """Options of a source; frozen dataclasses entered in `RESIDUALS`.

    Attributes:
        source: class of what `fit` gives.
    """

    source: ClassVar[type[ResidualSource]]

    @abstractmethod
    def fit(self, material: FitMaterial) -> ResidualSource | None:
        """Fit a source to healthy sessions; None if the channels are unsuitable.

        Raises:
            EdpError: material that cannot be used.
        """


class SideBySide(Protocol):
    """Calls a function for each of some jobs, and yields the results in the order of the jobs."""

    @property
    def is_elsewhere(self) -> bool:
        """Whether other processes do it, which cannot report progress."""
        ...

    def __call__(self, function: Callable[[Any], Any], jobs: Sequence[Any]) -> Iterable[Any]:
        """Yield ``function(job)`` of each job."""


class OneByOne:
    """Calls a function in this process."""

    is_elsewhere = False

    def __call__(self, function: Callable[[Any], Any], jobs: Sequence[Any]) -> Iterable[Any]:
        """Yield ``function(job)`` of each job."""
        return map(function, jobs)


ONE_BY_ONE = OneByOne()
RESIDUALS: Registry[type[ResidualSpec]] = Registry("residual")


def texts_of(values: Any, what: str) -> tuple[str, ...]:
    """Return a list of texts from a file after a check.

    Raises:
        ValueError: something else, or too many.
    """
    if not isinstance(values, list | tuple) or len(values) > MAX_RESIDUALS * 8:
        raise ValueError(f"{what} is no list of at most {MAX_RESIDUALS * 8} texts")
    if not all(isinstance(value, str) and len(value) <= 1024 for value in values):
        raise ValueError(f"{what} holds something else than texts of at most 1024 characters")
    return tuple(values)


def residuals_of(source: ResidualSource, recordings: Sequence[Recording], streams: int = 16) -> list[Rows]:
    """Return the residuals of whole recordings, each from its start, shape (ticks, residuals) each.

    A channel that a recording lacks is missing throughout.
    """
    piece = 2048
    order = sorted(range(len(recordings)), key=lambda i: recordings[i].samples)
    results: dict[int, Rows] = {}
    for first in range(0, len(order), streams):
        members = order[first : first + streams]
        inputs = [rows_of(recordings[i], source.inputs) for i in members]
        longest = max(len(rows) for rows in inputs)
        state, out = source.initial_state(len(members)), []
        for start in range(0, longest, piece):
            stop = min(start + piece, longest)
            # A shorter stream repeats its last tick; those residuals are cut off below.
            at = np.arange(start, stop)
            rows = np.stack([values[np.minimum(at, len(values) - 1)] for values in inputs])
            residuals, state = source.run(rows, state)
            out.append(residuals)
        whole = np.concatenate(out, axis=1)
        results.update({i: whole[lane, : len(inputs[lane])].copy() for lane, i in enumerate(members)})
    return [results[i] for i in range(len(recordings))]


def sisters_of(sources: Sequence[ResidualSource], tolerance: float, number: int) -> list[ResidualSource]:
    """Return sources as if the session were of another machine of the series, seeded by the session number."""
    if not tolerance:
        return list(sources)
    rng = np.random.default_rng([number, SISTERS])
    return [source.adjust_to_sister(rng, tolerance) for source in sources]


def rows_of(recording: Recording, names: Sequence[str]) -> Rows:
    """Return the values of the named channels, shape (ticks, names); NaN for a channel that the recording lacks."""
    values = np.full((recording.samples, len(names)), np.nan, np.float32)
    for column, name in enumerate(names):
        if name in recording.channel_names:
            values[:, column] = recording.column(name)
    return values


def residual_labels(plain: Mapping[str, object]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return inputs and units of a source from its plain values.

    Raises:
        ValueError: too many residuals, or something else than texts.
    """
    inputs, units = texts_of(plain["inputs"], "its inputs"), texts_of(plain["units"], "its units")
    if len(units) > MAX_RESIDUALS:
        raise ValueError(f"it has {len(units)} residuals; at most {MAX_RESIDUALS} must hold")
    return inputs, units


def mean_inputs(material: FitMaterial, inputs: Sequence[str]) -> Rows:
    """Return the mean of each input over the sessions that train, shape (inputs,)."""
    means = [session.select(inputs).mean(axis=0, dtype=np.float64) for session in material.train]
    return np.asarray(np.mean(means, axis=0), dtype=np.float32)


def source_arrays(parts: SourceParts, rules: Mapping[str, ArrayRule], **sizes: int) -> dict[str, NDArray[Any]]:
    """Check and return the arrays of a source, without the arrays of its parts, whose names contain a dot.

    Args:
        parts: of the source.
        rules: declarations of the arrays in addition to ``middle``.
        sizes: of dimensions in addition to ``inputs``.

    Raises:
        ValueError: values that cannot be.
    """
    own = {name: values for name, values in parts.arrays.items() if "." not in name}
    inputs = len(texts_of(parts.plain["inputs"], "its inputs"))
    return checked_arrays(own, {"middle": MIDDLE, **rules}, "a source", {"inputs": inputs, **sizes})
