"""What watches conditioned rows: a linear view of them and a detector on it, several side by side under one limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, DataError
from edp.monitor.detectors.base import Detector, DetectorSpec
from edp.settings.bounds import check_bounds, span

Array = NDArray[np.float64]
VIEWS = ("white", "adjusted")


@dataclass(frozen=True, kw_only=True)
class WatchSpec:
    """Options of one view.

    Attributes:
        detector: that sees it.
        memory_s: time over which rows are averaged where the covariance is taken that the view makes white; 0 takes
            single rows. A slow fault is a shift of averages, and averages of healthy sessions scatter more widely,
            in other directions, than independent rows would.
        shrink: share of the diagonal in that covariance.
        view: ``white``: uncorrelated directions; ``adjusted``: each summary less what the others tell of it (Hawkins,
            Technometrics 33, 1991), the best view of a shift of one summary alone.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    detector: DetectorSpec
    memory_s: float = 0.0
    shrink: float = 0.1
    view: str = "white"

    def __post_init__(self) -> None:
        if self.view not in VIEWS:
            raise ConfigError(f"watches: view = '{self.view}'; one of {', '.join(VIEWS)} must hold")
        check_bounds("watches", self, memory_s=span(0.0, 3600.0), shrink=span(0.0, 1.0))


@dataclass(frozen=True, eq=False)
class Watch:
    """A fitted view.

    Attributes:
        detector: that sees it.
        mean: of healthy rows, shape (summaries,).
        matrix: shape (summaries, directions).
        scale: of the detector's statistic: over it, statistics of all watches are compared with one limit.
    """

    detector: DetectorSpec
    mean: Array
    matrix: Array
    scale: float = 1.0

    @property
    def directions(self) -> int:
        """Numbers that the detector sees."""
        return int(self.matrix.shape[1])

    def __call__(self, rows: Array) -> Array:
        """White rows, shape (blocks, directions); a missing summary counts as healthy.

        Each sum goes from the first summary to the last, as in C.
        """
        centred = rows - self.mean
        centred = np.where(np.isfinite(centred), centred, 0.0)
        white = np.zeros((len(rows), self.directions))
        for index in range(centred.shape[1]):
            white = white + centred[:, index, None] * self.matrix[index]
        return white


def fit_watch(spec: WatchSpec, sessions: Sequence[Array], blocks_per_s: float, settle: int) -> Watch:
    """A view from conditioned rows of healthy sessions, shape (blocks, summaries) each.

    Raises:
        DataError: too few rows.
    """
    usual = int(np.median([len(session) - settle for session in sessions])) if sessions else 0
    # A quarter of a session at most: of longer averages there would be too few.
    blocks = max(1, min(round(spec.memory_s * blocks_per_s), usual // 4))
    rows = np.concatenate([_averaged(np.nan_to_num(session[settle:]), blocks) for session in sessions])
    if len(rows) < LEAST_ROWS:
        raise DataError(
            f"{len(rows)} averages over {blocks} blocks are too few for a covariance; {LEAST_ROWS} at least must hold: "
            "bring more hours"
        )
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


def _averaged(rows: Array, blocks: int) -> Array:
    """Means of `blocks` rows, every half of that; of a shorter session the mean of all."""
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
    """All watches as one detector: its rows are the white rows of each, one behind the other; the largest counts."""

    watches: tuple[Watch, ...]

    def build(self, channels: int, lanes: int = 1) -> Detector:
        """See `DetectorSpec.build`."""
        bank = _Bank(self.watches, lanes)
        if bank.channels != channels:
            raise DataError(f"rows of {channels} numbers; the watches see {bank.channels}")
        return bank

    def white(self, rows: Array) -> Array:
        """Rows as the bank takes them, of conditioned ones."""
        return np.concatenate([watch(rows) for watch in self.watches], axis=1)


def scaled_alike(watches: Sequence[Watch], sessions: Sequence[Array], settle: int) -> tuple[Watch, ...]:
    """The watches with scales at which each is as eager: its third largest statistic of all healthy sessions.

    Args:
        watches: with a scale of one.
        sessions: conditioned rows of healthy sessions.
        settle: blocks of the start of a session that are not watched.
    """
    result = []
    for watch in watches:
        peaks = []
        for session in sessions:
            detector, white = watch.detector.build(watch.directions), watch(session[settle:])
            values = [float(detector.step(row[None])[0]) for row in white]
            peaks.append(max(values, default=0.0))
        scale = float(np.sort(peaks)[-min(EAGER, len(peaks))]) if peaks else 1.0
        result.append(Watch(watch.detector, watch.mean, watch.matrix, max(scale, 1e-9)))
    return tuple(result)


LEAST_ROWS = 16
"""Of averages that a covariance is taken of; the diagonal that is mixed in stands for what they do not tell."""
EAGER = 3
"""Of the largest statistics of healthy sessions, which one makes watches equal: near the limit, where tails differ."""
