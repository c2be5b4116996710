"""Data table of a screening: candidate channels of all recordings, divided into segments that are compared."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from edp.data.gathered import on_demand, some_columns
from edp.data.screening.result import Array
from edp.data.screening.spec import ScreeningSpec
from edp.errors import DataError, closest
from edp.recording import MAX_ROWS, FloatArray, Recording, spread_stretches
from edp.signals import TABLE_A1, Kind
from edp.wording import typed

MIN_LAGS, LAGS_A_STRETCH = 5, 40
"""Largest lags that a recording is long at least, and that a segment of a large data set is."""
MAX_PIECES = 24
"""Beyond, several recordings form a piece."""
_GROUPS = {
    "CylVels": "cylinder velocity",
    "CylAcc": "cylinder acceleration",
    "CylPressures": "cylinder pressure",
}


@dataclass(frozen=True, eq=False)
class Piece:
    """Segment for comparison: contiguous parts of recordings, each float32 ``(time, channel)``."""

    name: str
    stretches: tuple[FloatArray, ...]

    @property
    def samples(self) -> int:
        """Number of rows of all parts."""
        return sum(len(stretch) for stretch in self.stretches)


@dataclass(frozen=True, eq=False)
class CandidateTable:
    """Candidates with finite values, targets among them.

    Attributes:
        names: channels, in the order of the columns.
        groups: kind of signal of each, as Table 4.2 groups them.
        targets: columns of the targets.
        pieces: candidates to compare.
        rate_hz: samples per second.
        missing: names of the candidates left out since values are missing, with their count.
        left_out: names of recordings that are too short for the lags.
    """

    names: tuple[str, ...]
    groups: tuple[str, ...]
    targets: tuple[int, ...]
    pieces: tuple[Piece, ...]
    rate_hz: float
    missing: dict[str, int]
    left_out: tuple[str, ...] = ()

    @property
    def samples(self) -> int:
        """Number of rows of all segments."""
        return sum(piece.samples for piece in self.pieces)

    @cached_property
    def sums(self) -> tuple[Array, Array]:
        """Mean and variance of each segment and channel, float64, each ``(segment, channel)``."""
        means, variances = [], []
        for piece in self.pieces:
            mean = sum(s.sum(axis=0, dtype=np.float64) for s in piece.stretches) / piece.samples
            squares = np.zeros(len(self.names))
            for chunk in chunks(piece.stretches):
                squares += np.square(chunk - mean).sum(axis=0)
            means.append(mean)
            # sums of millions of float32 values are not exactly zero for a constant channel
            first = piece.stretches[0][0]
            constant = np.all([(s == first).all(axis=0) for s in piece.stretches], axis=0)
            variances.append(np.where(constant, 0.0, squares / piece.samples))
        return np.array(means), np.array(variances)

    @cached_property
    def mean(self) -> Array:
        """Mean over all rows, ``(channel,)``."""
        return np.average(self.sums[0], axis=0, weights=[piece.samples for piece in self.pieces])

    @cached_property
    def within(self) -> Array:
        """Standard deviation within segments, pooled, ``(channel,)``."""
        return np.sqrt(np.average(self.sums[1], axis=0, weights=[piece.samples for piece in self.pieces]))

    @cached_property
    def between(self) -> Array:
        """Fraction of the variance between the means of the segments, ``(channel,)``; 0 for a constant channel."""
        weights = [piece.samples for piece in self.pieces]
        among = np.average(np.square(self.sums[0] - self.mean), axis=0, weights=weights)
        total = among + np.square(self.within)
        result: Array = np.divide(among, total, out=np.zeros_like(total), where=total > 0)
        return result

    @cached_property
    def live(self) -> NDArray[np.bool_]:
        """Whether a channel changes within a segment, ``(channel,)``."""
        # Relative to the mean: rounding of a constant pressure of 30 MPa is no movement.
        return self.within > 1e-9 * np.abs(self.mean)

    def thinned(self, count: int, ahead: int = 0) -> list[NDArray[np.int64]]:
        """Return `count` evenly spaced row indices in total, one array per part in order.

        Each row has `ahead` rows after it.
        """
        lengths = [len(stretch) - ahead for piece in self.pieces for stretch in piece.stretches]
        total = sum(max(length, 0) for length in lengths)
        row_indices = np.linspace(0, total - 1, min(count, total)).astype(np.int64)
        rows, start = [], 0
        for length in lengths:
            inside = row_indices[(row_indices >= start) & (row_indices < start + max(length, 0))]
            rows.append(inside - start)
            start += max(length, 0)
        return rows

    def sample(self, count: int) -> FloatArray:
        """Return evenly spaced rows of all segments, float32 ``(row, channel)``."""
        stretches = [stretch for piece in self.pieces for stretch in piece.stretches]
        return np.concatenate([s[rows] for s, rows in zip(stretches, self.thinned(count), strict=True)])


def chunks(stretches: Sequence[FloatArray], rows: int = 32_768) -> Iterator[Array]:
    """Return the segments in float64, some rows at a time."""
    return (s[i : i + rows].astype(np.float64) for s in stretches for i in range(0, len(s), rows))


def build_table(recordings: Sequence[Recording], spec: ScreeningSpec) -> CandidateTable:
    """Collect candidates and targets, and divide the recordings into segments.

    Raises:
        DataError: no recordings, mixed rates, a channel that a recording lacks, no target, missing values in a
            target, or too short recordings for the lags asked for.
    """
    if not recordings:
        raise DataError("there are no recordings to screen; give a log or a folder of logs")
    first = recordings[0]
    for other in recordings[1:]:
        if abs(other.rate_hz - first.rate_hz) > 1e-3 * first.rate_hz:
            raise DataError(
                f"recording '{other.name}' has {typed(other.rate_hz)} Hz, '{first.name}' {typed(first.rate_hz)} Hz; "
                "screening "
                "needs one rate: set rate_hz in the signal map"
            )
    recordings, short = _long_enough(recordings, spec.max_lag)
    targets = spec.targets or _usual_targets(first)
    names = tuple(dict.fromkeys((*(spec.candidates or first.channel_names), *targets)))
    for name in (*names, *spec.measured):
        if name not in first.channel_names:
            raise DataError(
                f"screening asks for '{name}', which '{first.name}' lacks{closest(name, first.channel_names)}"
            )
    names = tuple(sorted(names, key=first.index))
    columns = [
        on_demand(recording.values, [recording.index(name) for name in names])
        if recording.on_disk
        else recording.select(names)
        for recording in recordings
    ]
    missing = _missing(names, columns)
    blind = [name for name in targets if name in missing]
    if blind:
        raise DataError(
            f"target '{blind[0]}' has {missing[blind[0]]} missing or infinite value(s); repair the log or ask for a "
            'repair (nan = "hold")'
        )
    present_columns = [i for i, name in enumerate(names) if name not in missing]
    if missing:
        columns = [some_columns(values, present_columns) for values in columns]
    names = tuple(names[i] for i in present_columns)
    kinds = {channel.name: channel.kind for channel in first.channels}
    table = CandidateTable(
        names,
        tuple(group_of(name, kinds[name]) for name in names),
        tuple(names.index(name) for name in targets),
        _thin_segments(_pieces([r.name for r in recordings], columns, spec), spec.max_lag),
        first.rate_hz,
        missing,
        short,
    )
    still = [names[i] for i in table.targets if not table.live[i]]
    if still:
        raise DataError(f"target '{still[0]}' never changes; it cannot be predicted: choose another target")
    return table


def group_of(name: str, kind: Kind) -> str:
    """Return the signal group as in Table 4.2; other channels are grouped by their kind."""
    if name in TABLE_A1:
        if kind == Kind.PILOT_PRESSURE:
            return "conflux pilot pressure" if name.endswith("Conf") else "pilot pressure"
        return _GROUPS[name.split("_")[0]]
    return str(kind).replace("_", " ")


def _usual_targets(recording: Recording) -> tuple[str, ...]:
    thesis_targets = tuple(name for name in TABLE_A1 if name.startswith("CylVels") and name in recording.channel_names)
    targets = thesis_targets or tuple(
        c.name for c in recording.channels if c.kind in (Kind.VELOCITY, Kind.ANGULAR_VELOCITY)
    )
    if not targets:
        raise DataError(
            f"recording '{recording.name}' has no velocity, so that screening does not know what is to be predicted; "
            "name the targets, or map a channel with kind velocity"
        )
    return targets


def _long_enough(recordings: Sequence[Recording], max_lag: int) -> tuple[Sequence[Recording], tuple[str, ...]]:
    """Return the recordings of at least five times the largest lag, and the names of the others."""
    # A correlation at the largest lag then rests on four fifths of the rows at least.
    least = MIN_LAGS * max_lag
    long = [recording for recording in recordings if recording.samples >= least]
    short = tuple(recording.name for recording in recordings if recording.samples < least)
    if sum(recording.samples for recording in long) < 4 * least:
        most = max(recording.samples for recording in recordings)
        raise DataError(
            f"lags up to {max_lag} samples need recordings of at least {least} samples, four times that in all; "
            f"{len(long)} of {len(recordings)} recordings are long enough, the longest has {most}: lower max_lag, or "
            "give longer recordings"
        )
    return long, short


def _missing(names: Sequence[str], columns: Sequence[FloatArray]) -> dict[str, int]:
    """Return the channels with missing or infinite values and how many."""
    counts = np.zeros(len(names), dtype=np.int64)
    for values in columns:
        for start in range(0, len(values), 65_536):
            counts += (~np.isfinite(values[start : start + 65_536])).sum(axis=0)
    return {name: int(count) for name, count in zip(names, counts) if count}


def _pieces(names: Sequence[str], columns: Sequence[FloatArray], spec: ScreeningSpec) -> tuple[Piece, ...]:
    """Return one segment per recording.

    Long recordings are divided if there are too few, neighbours are joined if there are too many.
    """
    total = sum(len(values) for values in columns)
    pieces: list[Piece] = []
    if len(columns) >= spec.min_segments:
        # lagged covariances of all pairs are held for every piece: a gigabyte at most
        each = 4 * (2 * spec.max_lag + 1) * columns[0].shape[1] ** 2
        per = -(-len(columns) // max(spec.min_segments, min(MAX_PIECES, int(1e9 / each))))
        for start in range(0, len(columns), per):
            label = names[start] if per == 1 else f"{names[start]} to {names[min(start + per, len(names)) - 1]}"
            pieces.append(Piece(label, tuple(columns[start : start + per])))
    else:
        for name, values in zip(names, columns, strict=True):
            # a part is as long as the lags need, if that leaves fewer parts than asked for
            parts = max(
                1, min(round(spec.min_segments * len(values) / total + 0.499), len(values) // (5 * spec.max_lag))
            )
            edges = np.linspace(0, len(values), parts + 1).astype(int)
            for i in range(parts):
                label = name if parts == 1 else f"{name} part {i + 1}"
                pieces.append(Piece(label, (values[edges[i] : edges[i + 1]],)))
    return tuple(pieces)


def _thin_segments(pieces: tuple[Piece, ...], max_lag: int) -> tuple[Piece, ...]:
    """Return segments with about `MAX_ROWS` rows in total, as evenly spaced parts of each recording in memory."""
    lengths = [len(stretch) for piece in pieces for stretch in piece.stretches]
    if sum(lengths) <= MAX_ROWS:
        return pieces
    owners = [p for p, piece in enumerate(pieces) for _ in piece.stretches]
    whole = [stretch for piece in pieces for stretch in piece.stretches]
    stretches_of_piece: list[list[FloatArray]] = [[] for _ in pieces]
    for i, start, stop in spread_stretches(lengths, LAGS_A_STRETCH * max_lag):
        # Rest at the end of a recording may be too short for the lags.
        if stop - start >= MIN_LAGS * max_lag:
            stretches_of_piece[owners[i]].append(np.ascontiguousarray(whole[i][start:stop]))
    return tuple(Piece(piece.name, tuple(own)) for piece, own in zip(pieces, stretches_of_piece, strict=True) if own)
