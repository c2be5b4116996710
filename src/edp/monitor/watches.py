"""Watches on conditioned rows: a linear view with a detector each, several in parallel under one limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, DataError
from edp.monitor.detectors.base import Detector, DetectorSpec
from edp.settings.bounds import check_bounds, span

Array = NDArray[np.float64]
VIEWS = ("white", "adjusted", "own")


@dataclass(frozen=True, kw_only=True)
class WatchSpec:
    """Options of one view.

    Attributes:
        detector: detector of the view.
        memory_s: time over which rows are averaged where the covariance is taken that the view makes white; 0 takes
            single rows. A slow fault is a shift of averages, and averages of healthy sessions scatter more widely,
            in other directions, than independent rows would.
        shrink: share of the diagonal in that covariance.
        view: ``white``: uncorrelated directions; ``adjusted``: each summary less what the others tell of it (Hawkins,
            Technometrics 33, 1991), the best view of a shift of one summary alone; ``own``: each summary by itself, not
            clipped, over the largest size that it has on healthy machines: what is gross is seen at once, and a summary
            with rare large values is given its own measure.
        reserve: factor of the scale of its statistic. A view that is there for what is gross keeps away from the limit
            by more than 1, so that of the false alarms that are expected it takes a small share.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    detector: DetectorSpec
    memory_s: float = 0.0
    shrink: float = 0.1
    view: str = "white"
    reserve: float = 1.0

    def __post_init__(self) -> None:
        if self.view not in VIEWS:
            raise ConfigError(f"watches: view = '{self.view}'; one of {', '.join(VIEWS)} must hold")
        check_bounds("watches", self, memory_s=span(0.0, 3600.0), shrink=span(0.0, 1.0), reserve=span(0.1, 100.0))


@dataclass(frozen=True, eq=False)
class Watch:
    """A fitted view.

    Attributes:
        detector: detector of the view.
        mean: mean of healthy rows, shape (summaries,).
        matrix: shape (summaries, directions), or (summaries,) of factors where it sees each summary by itself.
        scale: scale of the statistic. Scaled statistics of all watches are compared with one limit.
    """

    detector: DetectorSpec
    mean: Array
    matrix: Array
    scale: float = 1.0

    @property
    def directions(self) -> int:
        """Numbers that the detector sees."""
        return int(self.matrix.shape[-1])

    @property
    def own(self) -> bool:
        """Whether each summary is monitored by itself, without clipping."""
        return self.matrix.ndim == 1

    def __call__(self, rows: Array) -> Array:
        """Return the white rows, shape (blocks, directions); a missing summary counts as healthy.

        Each sum goes from the first summary to the last in single precision, as in C.
        """
        centred = rows - self.mean
        # Single precision: a controller computes it in hardware, forty times as fast as doubles.
        part = np.where(np.isfinite(centred), centred, 0.0).astype(np.float32)
        matrix = self.matrix.astype(np.float32)
        if self.own:
            return (part * matrix).astype(np.float64)
        white = np.zeros((len(rows), self.directions), np.float32)
        for first in range(0, len(rows), ROWS_AT_ONCE):
            some, sums = part[first : first + ROWS_AT_ONCE], white[first : first + ROWS_AT_ONCE]
            terms = np.empty_like(sums)
            for index in range(part.shape[1]):
                np.multiply(some[:, index, None], matrix[index], out=terms)
                np.add(sums, terms, out=sums)
        return white.astype(np.float64)


def check_rows(spec: WatchSpec, lengths: Sequence[int], blocks_per_s: float) -> int:
    """Return over how many blocks a view averages; refuse sessions that are too short for its covariance.

    Args:
        spec: options of the view.
        lengths: watched blocks of each healthy session.
        blocks_per_s: rate of the blocks.

    Raises:
        DataError: too few rows.
    """
    usual = int(np.median(lengths)) if lengths else 0
    # A quarter of a session at most: of longer averages there would be too few.
    blocks = max(1, min(round(spec.memory_s * blocks_per_s), usual // 4))
    rows = sum(_averages(length, blocks) for length in lengths)
    if spec.view != "own" and rows < MIN_ROWS:
        raise DataError(
            f"{rows} averages over {blocks} blocks are too few for a covariance; {MIN_ROWS} at least must hold: "
            "bring more hours"
        )
    return blocks


def _averages(length: int, blocks: int) -> int:
    """Return the number of averages that `_average_blocks` computes from a number of rows."""
    if blocks == 1 or length <= 0:
        return max(length, 0)
    return max(0, length - blocks) // max(1, blocks // 2) + 1


def fit_watch(spec: WatchSpec, sessions: Sequence[Array], blocks_per_s: float, settle: int) -> Watch:
    """Fit a view to conditioned rows of healthy sessions, shape (blocks, summaries) each; unclipped for ``own``.

    Raises:
        DataError: too few rows.
    """
    if spec.view == "own":
        return _own(spec, sessions, settle)
    blocks = check_rows(spec, [len(session) - settle for session in sessions], blocks_per_s)
    rows = np.concatenate([_average_blocks(np.nan_to_num(session[settle:]), blocks) for session in sessions])
    mean = rows.mean(axis=0)
    centred = rows - mean
    covariance = centred.T @ centred / len(rows)
    variances = np.diag(covariance)
    there = variances > 1e-9 * max(float(variances.max()), 1e-300)
    size = np.sqrt(np.where(there, variances, 1.0))
    correlation = (covariance / np.outer(size, size))[np.ix_(there, there)]
    correlation = (1.0 - spec.shrink) * correlation + spec.shrink * np.eye(int(there.sum()))
    values, vectors = np.linalg.eigh(correlation)
    fine = values > 1e-6
    # An average of `blocks` independent white rows has a variance of 1 / blocks: single rows then have about one.
    wide = np.sqrt(values[fine] * blocks)
    view = vectors[:, fine] / wide
    if spec.view == "adjusted":
        inverse = (vectors[:, fine] / values[fine]) @ vectors[:, fine].T
        view = inverse / np.sqrt(np.diag(inverse) * blocks)
    matrix = np.zeros((rows.shape[1], view.shape[1]))
    matrix[there] = view / size[there][:, None]
    # Single precision: a controller stores half as much, and the bits stay the same.
    mean, matrix = (values.astype(np.float32).astype(np.float64) for values in (mean, matrix))
    return Watch(spec.detector, mean, matrix)


def _own(spec: WatchSpec, sessions: Sequence[Array], settle: int) -> Watch:
    """Return each summary over the largest size that it has on healthy machines."""
    peaks = [np.abs(np.nan_to_num(session[settle:])).max(axis=0) for session in sessions if len(session) > settle]
    if not peaks:
        raise DataError("no healthy session is longer than the start that is not watched: bring longer ones")
    largest = np.sort(peaks, axis=0)[-min(EAGER, len(peaks))]
    factors = (1.0 / np.maximum(largest, MIN_GROSS)).astype(np.float32).astype(np.float64)
    return Watch(spec.detector, np.zeros(len(factors)), factors)


def _average_blocks(rows: Array, blocks: int) -> Array:
    """Return means of `blocks` rows with half overlap; for a shorter session the overall mean."""
    if blocks == 1 or not len(rows):
        return rows
    if len(rows) <= blocks:
        whole: Array = rows.mean(axis=0, keepdims=True)
        return whole
    sums = np.concatenate([np.zeros((1, rows.shape[1])), np.cumsum(rows, axis=0)])
    starts = np.arange(0, len(rows) - blocks + 1, max(1, blocks // 2))
    averages: Array = (sums[starts + blocks] - sums[starts]) / blocks
    return averages


class _Bank(Detector):
    def __init__(self, watches: Sequence[Watch], lanes: int) -> None:
        super().__init__(sum(watch.directions for watch in watches), lanes)
        self.detectors = [watch.detector.build(watch.directions, lanes) for watch in watches]
        self.scales = [watch.scale for watch in watches]
        self.ends = np.cumsum([0, *(watch.directions for watch in watches)]).tolist()
        self.each = np.zeros((len(watches), lanes))

    def _take(self, rows: Array) -> Array:
        for index, detector in enumerate(self.detectors):
            part = rows[:, self.ends[index] : self.ends[index + 1]]
            self.each[index] = detector.step(part) / self.scales[index]
        largest: Array = self.each.max(axis=0)
        return largest

    def reset(self, lanes: NDArray[np.bool_] | None = None) -> None:
        for detector in self.detectors:
            detector.reset(lanes)


@dataclass(frozen=True, eq=False)
class BankSpec(DetectorSpec):
    """All watches as one detector on the concatenated white rows; the largest statistic counts."""

    watches: tuple[Watch, ...]

    def build(self, channels: int, lanes: int = 1) -> Detector:
        """See `DetectorSpec.build`."""
        bank = _Bank(self.watches, lanes)
        if bank.channels != channels:
            raise DataError(f"rows of {channels} numbers; the watches see {bank.channels}")
        return bank

    def white(self, rows: Array, gross: Array) -> Array:
        """Return the rows as the bank takes them, of conditioned ones that are clipped and of those that are not."""
        return np.concatenate([watch(gross if watch.own else rows) for watch in self.watches], axis=1)


def scale_watches(specs: Sequence[WatchSpec], watches: Sequence[Watch], sessions: Sequence[Array]) -> tuple[Watch, ...]:
    """Return the watches scaled to equal sensitivity: by the third largest statistic of all healthy sessions.

    Args:
        specs: options of the watches; their reserve is a factor of the scale.
        watches: watches with scale one.
        sessions: white rows of healthy sessions as a bank of these watches takes them.
    """
    result, first = [], 0
    for spec, watch in zip(specs, watches, strict=True):
        peaks = []
        for white in sessions:
            detector = watch.detector.build(watch.directions)
            values = [float(detector.step(row[None])[0]) for row in white[:, first : first + watch.directions]]
            peaks.append(max(values, default=0.0))
        first += watch.directions
        scale = float(np.sort(peaks)[-min(EAGER, len(peaks))]) if peaks else 1.0
        result.append(Watch(watch.detector, watch.mean, watch.matrix, spec.reserve * max(scale, 1e-9)))
    return tuple(result)


ROWS_AT_ONCE = 64
"""Number of rows of a view at a time, so that their sums stay in the processor's cache."""
MIN_ROWS = 16
"""Minimum number of averages for a covariance. A diagonal term is added for undetermined directions."""
MIN_GROSS = 3.0
"""Minimum threshold of a gross deviation, in healthy standard deviations."""
EAGER = 3
"""Rank of the session statistic that scales a watch, counted from the largest, so that the watches agree near the alarm
limit.
"""
