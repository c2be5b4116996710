"""Sampling of training chunks: long segments in parallel batch rows, the state is carried from chunk to chunk.

Windows are a special case.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from edp.data.augment import AugmentationSpec, input_deviation
from edp.data.order import RandomOrder
from edp.data.series import Series
from edp.errors import ConfigError, DataError
from edp.settings.bounds import MAX_BATCH, MOST_TICKS, check_bounds, integer


@dataclass(frozen=True, kw_only=True)
class ChunkSpec:
    """Settings for cutting recordings into training chunks.

    Attributes:
        regime: ``chunk`` walks lanes with carried state, one target per sample; ``window`` draws windows of
            `length` samples, each from reset with one target at its last sample (thesis 3.1.4, stride 1).
        length: samples per chunk, or W.
        batch: lanes in parallel, or windows per update.
        burn_in: samples after a reset that give no loss (chunk regime).
        consecutive: windows that end at consecutive samples and are drawn together, for terms of the loss that
            compare neighbours (window regime).
        reset_after_chunks: chunks that a stream is carried on before it starts again (chunk regime); where the data do
        not fill
            all lanes they are walked again, cut elsewhere. 0: at least 8, and at most an even share of a lane.

    Raises:
        ConfigError: a value out of range.
    """

    regime: str = "chunk"
    length: int = 128
    batch: int = 16
    burn_in: int = 50
    consecutive: int = 1
    reset_after_chunks: int = 0

    def __post_init__(self) -> None:
        if self.regime not in ("chunk", "window"):
            raise ConfigError(f"regime = '{self.regime}'; 'chunk' or 'window' must hold")
        check_bounds(
            "chunks",
            self,
            length=integer(1, MOST_TICKS),
            batch=integer(1, MAX_BATCH),
            burn_in=integer(0, MOST_TICKS),
            consecutive=integer(1, MAX_BATCH),
            reset_after_chunks=integer(0, MAX_BATCH),
        )
        if self.batch % self.consecutive:
            raise ConfigError(
                f"chunks: consecutive = {self.consecutive}, batch = {self.batch}; consecutive of at least 1 and a "
                "batch that is a multiple of it must hold"
            )
        if self.reset_after_chunks and self.regime == "window":
            raise ConfigError(
                f"chunks: reset_after_chunks = {self.reset_after_chunks} with regime = '{self.regime}'; expected 0, "
                "since each window starts from a reset"
            )
        if self.reset_after_chunks and self.reset_after_chunks * self.length <= self.burn_in:
            raise ConfigError(
                f"chunks: reset_after_chunks = {self.reset_after_chunks} chunks of {self.length} ticks are no longer "
                f"than burn_in = {self.burn_in}, so no tick would have a loss; make one of them longer"
            )
        if self.consecutive > 1 and self.regime == "chunk":
            raise ConfigError(
                f"chunks: consecutive = {self.consecutive} with regime = 'chunk'; the ticks of a chunk are consecutive "
                "already, so 1 must hold"
            )


@dataclass(frozen=True, eq=False)
class Batch:
    """One training step.

    Attributes:
        inputs: ``(batch, time, input)`` SI units.
        future: ``(batch, time, horizon, target)``: the target channels at t + k, SI units.
        valid: ``(batch, time)``: where a loss is taken.
        reset: ``(batch,)``: streams that start again with this chunk.
        strategy_columns: ``(batch, time, column)``: what a training strategy reads of each tick; None without.
    """

    inputs: NDArray[np.float32]
    future: NDArray[np.float32]
    valid: NDArray[np.bool_]
    reset: NDArray[np.bool_]
    strategy_columns: NDArray[np.float32] | None = None

    @property
    def targets_seen(self) -> int:
        """Ticks with a loss."""
        return int(self.valid.sum())


Piece = tuple[Any, Any, Any, Any]
"""Inputs, future targets, validity and teacher targets of some ticks."""


class Sampler(Protocol):
    """Source of the training batches."""

    def epoch(self, number: int) -> Iterator[Batch]:
        """Yield the batches of epoch `number`, which depend on this number and the seed only."""
        ...

    def updates(self, number: int = 0) -> int:
        """Return how many batches an epoch has."""
        ...


class ChunkSampler:
    """Batches of one epoch as a pure function of (seed, epoch), so that a resumed run sees the same ones.

    Args:
        series: the training segments.
        horizons: look-ahead samples.
        spec: chunk length, lanes, burn-in.
        seed: root of the random order.
        augmentations: applied in order to each segment from a reset to the next one.

    Raises:
        DataError: a segment shorter than burn-in (or window) plus the largest horizon.
    """

    def __init__(
        self,
        series: Sequence[Series],
        horizons: Sequence[int],
        spec: ChunkSpec,
        seed: int,
        augmentations: Sequence[AugmentationSpec] = (),
    ) -> None:
        self.series, self.horizons, self.spec, self.seed = list(series), tuple(horizons), spec, seed
        self.augmentations = tuple(augmentations)
        self.deviation = input_deviation(self.series) if augmentations else None
        lead = spec.burn_in if spec.regime == "chunk" else spec.length + spec.consecutive - 2
        for part in self.series:
            if part.samples <= lead + max(horizons):
                raise DataError(
                    f"recording '{part.name}' has {part.samples} samples, shorter than the burn-in of {lead} plus the "
                    f"horizon of {max(horizons)}; give a longer recording, or a smaller burn_in or window"
                )

    def epoch(self, number: int) -> Iterator[Batch]:
        """Yield the batches of epoch `number`."""
        rng = np.random.default_rng([self.seed, number])
        return self._windows(rng, number) if self.spec.regime == "window" else self._lanes(rng, number)

    def updates(self, number: int = 0) -> int:
        """Return how many batches an epoch has."""
        if self.spec.regime == "window":
            total = sum(self._groups(part, 0) for part in self.series) * self.spec.consecutive
            # Rounded up: the last batch may be smaller.
            return -(-total // self.spec.batch)
        return max(_ticks(lane) for lane in self._plan(np.random.default_rng([self.seed, number]))) // self.spec.length

    def _plan(self, rng: np.random.Generator) -> list[list[tuple[int, int, int]]]:
        """Distribute segments (series, start, stop) over the batch rows with nearly equal load.

        Lengths are multiples of the chunk length.
        """
        length, lanes = self.spec.length, self.spec.batch
        total = sum(part.samples for part in self.series)
        # At least a few chunks per piece, and twice the burn-in: a piece that is no longer than it would never end.
        least = max(8, -(-2 * self.spec.burn_in // length))
        # At most an even share of a lane.
        piece = (self.spec.reset_after_chunks or max(least, -(-total // (lanes * length * 4)))) * length
        pieces = list(self._pieces(rng, piece))
        while self.spec.reset_after_chunks and len(pieces) < lanes:  # Short data are walked again, cut elsewhere.
            pieces += self._pieces(rng, piece)
        queue = [pieces[i] for i in rng.permutation(len(pieces))]
        plan: list[list[tuple[int, int, int]]] = [[] for _ in range(lanes)]
        load = np.zeros(lanes, dtype=np.int64)
        # Longest first onto the least loaded lane: the usual heuristic that leaves lanes nearly equal.
        for entry in sorted(queue, key=lambda p: p[1] - p[2]):
            lane = int(load.argmin())
            plan[lane].append(entry)
            load[lane] += entry[2] - entry[1]
        return [[lane[i] for i in rng.permutation(len(lane))] for lane in plan]

    def _pieces(self, rng: np.random.Generator, piece: int) -> Iterator[tuple[int, int, int]]:
        """Yield segments of `piece` samples that cover all series."""
        length = self.spec.length
        for i in rng.permutation(len(self.series)):
            samples = self.series[i].samples
            # Cut elsewhere in each epoch, but never so late that much of a short series is lost.
            start = int(rng.integers(0, min(length, max(1, samples // 8))))
            while start < samples - self.spec.burn_in - max(self.horizons):
                rest = -(-(samples - start) // length) * length
                size = min(piece, rest)
                yield int(i), start, start + size
                # The next piece overlaps by the burn-in, so that every sample gets a loss.
                start += size - self.spec.burn_in if size < rest else size

    def _lanes(self, rng: np.random.Generator, number: int) -> Iterator[Batch]:
        length = self.spec.length
        plan = self._plan(rng)
        lanes = [self._lane(lane, number) for lane in plan]
        spare = self._cut(self.series[0], 0, 0, length)
        for _ in range(max(_ticks(lane) for lane in plan) // length):
            # A lane that has run out: nothing counts.
            steps = [next(lane, (spare, True)) for lane in lanes]
            yield stack([piece for piece, _ in steps], [reset for _, reset in steps])

    def _lane(self, pieces: Sequence[tuple[int, int, int]], number: int) -> Iterator[tuple[Piece, bool]]:
        """Yield the chunks of one batch row in order, each with a flag that is true at the beginning of a segment."""
        length, burn_in = self.spec.length, self.spec.burn_in
        for i, start, stop in pieces:
            part, origin = self._stretch(i, start, stop, self._chance(number, i, start))
            for at in range(start, stop, length):
                yield self._cut(part, at - origin, at - start, burn_in), at == start

    def _windows(self, rng: np.random.Generator, number: int) -> Iterator[Batch]:
        length, together = self.spec.length, self.spec.consecutive
        # Groups of consecutive windows begin at another sample in each epoch.
        offsets = rng.integers(0, together, len(self.series)) if together > 1 else np.zeros(len(self.series), np.int64)
        ends = np.cumsum([self._groups(part, int(at)) for part, at in zip(self.series, offsets, strict=True)])
        order = RandomOrder(rng, int(ends[-1]))
        groups = self.spec.batch // together
        for first in range(0, len(order), groups):
            chosen = order.part(first, first + groups)
            rows, chance = [], self._chance(number, first)
            for i, j in zip(np.searchsorted(ends, chosen, side="right"), chosen, strict=True):
                start = int(offsets[i] + (j - (ends[i - 1] if i else 0)) * together)
                part, origin = self._stretch(int(i), start, start + length + together - 1, chance)
                rows += [self._cut(part, start + late - origin, 0, length - 1) for late in range(together)]
            # Windows always begin from reset.
            yield stack(rows, [True] * len(rows))

    def _groups(self, part: Series, offset: int) -> int:
        """Return the number of groups of consecutive windows in a series from `offset`."""
        return max(0, part.samples - self.spec.length + 1 - max(self.horizons) - offset) // self.spec.consecutive

    def _chance(self, *key: int) -> np.random.Generator | None:
        """Return a random generator for augmentation, seeded by the key, so that order and restarts do not matter."""
        return np.random.default_rng([self.seed, *key]) if self.augmentations else None

    def _stretch(self, i: int, start: int, stop: int, rng: np.random.Generator | None) -> tuple[Series, int]:
        """Return the series from which ``start:stop`` is cut, and the row of series i at which this series begins."""
        part = self.series[i]
        if rng is None or self.deviation is None:
            return part, 0
        stop = min(stop + max(self.horizons), part.samples)
        strategy_columns = None if part.strategy_columns is None else part.strategy_columns[start:stop]
        part = replace(
            part, inputs=part.inputs[start:stop], targets=part.targets[start:stop], strategy_columns=strategy_columns
        )
        for augmentation in self.augmentations:
            part = augmentation.apply(part, self.deviation, rng)
        return part, start

    def _cut(self, part: Series, at: int, age: int, burn_in: int) -> Piece:
        return cut(part, range(at, at + self.spec.length), self.horizons, burn_in - age)


def cut(part: Series, ticks: range, horizons: tuple[int, ...], silent: int) -> Piece:
    """Cut inputs, future targets, validity and teacher targets for a range of samples of a series.

    Args:
        part: the series.
        ticks: its rows; those past the end repeat the last, and count nothing.
        horizons: look-ahead samples.
        silent: so many of its first ticks have no loss.
    """
    at, length = ticks.start, len(ticks)
    inside = at + length + max(horizons) <= part.samples
    rows = np.arange(at, at + length)
    # Valid only where the farthest horizon lies in the series, so that all horizons have the same ticks.
    valid = (rows - at >= silent) & (rows + max(horizons) < part.samples)
    # Slices instead of indices: no copy of the inputs, for all pieces but the last of a series.
    if inside:
        future = np.stack([part.targets[at + k : at + k + length] for k in horizons], axis=1)
        return part.inputs[at : at + length], future, valid, _rows(part.strategy_columns, rows)
    last = part.samples - 1
    future = np.stack([part.targets[np.minimum(rows + k, last)] for k in horizons], axis=1)
    return part.inputs[np.minimum(rows, last)], future, valid, _rows(part.strategy_columns, np.minimum(rows, last))


def _rows(strategy_columns: NDArray[np.float32] | None, rows: NDArray[np.int64]) -> NDArray[np.float32] | None:
    return None if strategy_columns is None else strategy_columns[rows]


def _ticks(lane: list[tuple[int, int, int]]) -> int:
    return sum(stop - start for _, start, stop in lane)


def stack(rows: list[Piece], resets: list[bool]) -> Batch:
    """Return the segments side by side."""
    *columns, strategy_columns = zip(*rows, strict=True)
    inputs, future, valid = (np.stack(parts) for parts in columns)
    return Batch(
        inputs, future, valid, np.array(resets), None if strategy_columns[0] is None else np.stack(strategy_columns)
    )
