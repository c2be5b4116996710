"""The same session in two recordings: whole or in part, shifted, resampled, rescaled, or under other channel names.

Each recording leaves a sketch at 10 Hz. Of every 12.8 s of it the first cosine coefficients, scaled to length one, are
a fingerprint that neither offset, scale nor rate changes. Fingerprints that agree vote for a lag between two
recordings; the lag is then checked over the whole overlap, in every channel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from edp.logs.quality.sketches import Floats, Sketch
from edp.wording import number

WINDOW = 128
"""Number of samples of a fingerprint: 12.8 s."""
_HOP = 32
"""Distance of the windows that are searched in, less or more one by turns: at even and at odd blocks. Windows at even
blocks are searched for, so any lag, even or odd, meets one in 64 blocks."""
_STEP = 2
_COEFFICIENTS = 12
"""Number of cosine coefficients of a fingerprint: up to 0.47 Hz."""
_NEAR = 0.15
"""Maximum distance of two matching unit fingerprints: a correlation of 0.989."""
_NEIGHBOURS = 4
_MOVES = 0.1
"""Minimum standard deviation of a moving window, relative to the channel."""
_CHANNELS = 3
_OWN, _OWN_UNNAMED = 2, 16
_SAME = 0.98
"""Minimum correlation of a window in both recordings."""
_MIN_WINDOWS = 2
_MIN_VOTES = 3
"""Minimum number of fingerprints with a common lag before the lag is checked."""
_HOPELESS = 0.8
"""Correlation below which a shift by a fraction of a sample cannot make two windows equal."""
_MIN_SHARE = 0.5
"""Minimum fraction of the channels moving in a window that must agree. Steps of two sessions look alike in one channel
or another (correlations of 0.99 on a bench with two machines), but not in most of them."""
_MIN_UNBROKEN = 2 / 3
"""Minimum fraction of the windows in motion between the first and the last agreeing one that must agree. Within one
session all agree except for noise; of two similar sessions about half did."""
_SHIFTS = (0.0, -0.25, 0.25, -0.5, 0.5)
"""Shifts in fractions of a sample, because two recordings start at different times between samples of 10 Hz."""

Labels = NDArray[np.int64]
"""Recording and sample of fingerprints, shape ``(fingerprint, 2)``; or votes, see `_votes`."""


@dataclass(frozen=True)
class Repeat:
    """Two recordings that hold the same session.

    Attributes:
        first: one recording.
        second: the other.
        seconds: length of the common part, s.
        share: fraction of the shorter recording.
        first_from_s: start of the common part in the first recording, s.
        second_from_s: start of the common part in the second recording, s.
        channels: number of channels that agree.
        compared: number of moving channels that were compared.
        correlation: median over windows and channels that agree.
        renamed: channels that agree under another name, as (first, second).
        identical: every sample is the same.
    """

    first: str
    second: str
    seconds: float
    share: float
    first_from_s: float
    second_from_s: float
    channels: int
    compared: int
    correlation: float
    renamed: tuple[tuple[str, str], ...]
    identical: bool

    @property
    def what(self) -> str:
        """The finding in words."""
        if self.identical:
            return f"'{self.second}' holds the same samples as '{self.first}'"
        names = f", {len(self.renamed)} under other names" if self.renamed else ""
        return (
            f"'{self.second}' from {self.second_from_s:.1f} s repeats {self.seconds:.0f} s of '{self.first}' from "
            f"{self.first_from_s:.1f} s ({100 * self.share:.0f} % of the shorter one; correlation "
            f"{number(self.correlation, 4)}, {self.channels} of {self.compared} channels{names})"
        )

    def to_json(self) -> dict[str, object]:
        """Return the plain values."""
        return {**asdict(self), "renamed": [list(pair) for pair in self.renamed], "what": self.what}


def find_repeats(sketches: Sequence[Sketch]) -> tuple[Repeat, ...]:
    """Return pairs of recordings with the same session, the longest common segment first.

    Recordings shorter than 12.8 s are compared by their samples alone. A pair counts where at least two windows agree
    (correlation above 0.98 in more than half of the channels that move), and most of those between them, at one lag. Of
    copies only the first is compared with others.
    """
    repeats_by_pair = {pair: _identical(*(sketches[i] for i in pair)) for pair in _equal_pairs(sketches)}
    # Copies are named beside the recording that they copy: among each other, a hundred of them are 4,950 pairs.
    copies = {second for _, second in repeats_by_pair}
    own = [i for i in range(len(sketches)) if i not in copies]
    for (first, second), lag in _candidates([sketches[i] for i in own]).items():
        repeat = _check_candidate(sketches[own[first]], sketches[own[second]], lag)
        if repeat is not None:
            repeats_by_pair[own[first], own[second]] = repeat
    return tuple(sorted(repeats_by_pair.values(), key=lambda repeat: -repeat.seconds))


def _equal_pairs(sketches: Sequence[Sketch]) -> list[tuple[int, int]]:
    """Return each recording with the first that has the same samples."""
    seen: dict[str, int] = {}
    pairs = [(seen.setdefault(entry.digest, i), i) for i, entry in enumerate(sketches)]
    return [(first, second) for first, second in pairs if first != second]


def _identical(a: Sketch, b: Sketch) -> Repeat:
    count = len(a.channels)
    renamed = tuple((x, y) for x, y in zip(a.channels, b.channels, strict=True) if x != y)
    return Repeat(a.name, b.name, a.seconds, 1.0, 0.0, 0.0, count, count, 1.0, renamed, True)


def _candidates(sketches: Sequence[Sketch]) -> dict[tuple[int, int], int]:
    """Return the lag in blocks, per pair of recordings, with the most matching fingerprints.

    Fingerprints are made twice, a channel of a recording at a time: those of forty hours together take gigabytes.
    """
    # Imported where it is used: every reader of a log would wait for it, half as long as for all else.
    from scipy.spatial import cKDTree

    long = [i for i, entry in enumerate(sketches) if len(entry.values) >= WINDOW + _HOP]
    if len(long) < 2:
        return {}
    chosen = _telling(sketches)
    columns_of = [(i, column) for i in long for column in chosen[i]]
    searched: list[Floats] = []
    labels: list[Labels] = []
    for i, column in columns_of:
        values = sketches[i].values[:, column]
        marks, places = _fingerprints(values, _select_windows(len(values) - WINDOW + 1))
        searched.append(marks)
        labels.append(np.stack([np.full(len(places), i), places], axis=1))
    owners = np.concatenate(labels)
    if not len(owners):
        return {}
    tree = cKDTree(np.concatenate(searched))
    votes = []
    for i, column in columns_of:
        values = sketches[i].values[:, column]
        marks, places = _fingerprints(values, np.arange(0, len(values) - WINDOW + 1, _STEP))
        near, which = tree.query(marks, k=_NEIGHBOURS, distance_upper_bound=_NEAR)
        asked, rank = np.nonzero(np.isfinite(near))
        theirs = owners[which[asked, rank]]
        other = theirs[:, 0] != i
        votes.append(_votes(i, places[asked][other], theirs[other]))
    return _elect_lags(*(np.concatenate(part) for part in zip(*votes, strict=True)))


def _votes(i: int, places: NDArray[np.int64], theirs: Labels) -> tuple[Labels, NDArray[np.int64]]:
    """Return the votes of the windows of a recording, shape ``(vote, 3)``: two recordings and a lag.

    And their counts.
    """
    swap = i > theirs[:, 0]
    mine = np.stack([np.full(len(places), i), places], axis=1)
    a, b = np.where(swap[:, None], theirs, mine), np.where(swap[:, None], mine, theirs)
    return np.unique(np.stack([a[:, 0], b[:, 0], b[:, 1] - a[:, 1]], axis=1), axis=0, return_counts=True)


def _elect_lags(votes: Labels, numbers: NDArray[np.int64]) -> dict[tuple[int, int], int]:
    """Return the lag of each pair with enough votes."""
    votes, where = np.unique(votes, axis=0, return_inverse=True)
    counts = np.zeros(len(votes), dtype=np.int64)
    np.add.at(counts, where, numbers)
    # the true lag lies between two blocks: its votes may be shared by them
    follows = (np.diff(votes[:, :2], axis=0) == 0).all(axis=1) & (np.diff(votes[:, 2]) == 1)
    both = counts.copy()
    both[:-1] += np.where(follows, counts[1:], 0)
    both[1:] += np.where(follows, counts[:-1], 0)
    best: dict[tuple[int, int], tuple[int, int, int]] = {}
    for k in np.flatnonzero(both >= _MIN_VOTES).tolist():
        i, j, lag = (int(value) for value in votes[k])
        vote = (int(both[k]), int(counts[k]), lag)
        if vote[:2] > best.get((i, j), (0, 0, 0))[:2]:
            best[i, j] = vote
    return {pair: lag for pair, (_, _, lag) in best.items()}


def _telling(sketches: Sequence[Sketch]) -> list[list[int]]:
    """Return the columns of each recording from which fingerprints are taken.

    First the names that move most often over all recordings, so that the same are taken of each; then the recording's
    own liveliest: more of them where recordings share no name, so that renamed channels meet too.
    """
    names = [set(entry.channels) for entry in sketches]
    own_count = _OWN if all(mine & names[0] for mine in names) else _OWN_UNNAMED
    lively = [_lively(entry) for entry in sketches]
    total: dict[str, float] = {}
    for entry, shares in zip(sketches, lively):
        for name, share in zip(entry.channels, shares):
            total[name] = total.get(name, 0.0) + share
    telling = []
    for entry, shares in zip(sketches, lively):
        places = range(len(entry.channels))
        common = sorted(places, key=lambda i: (-total[entry.channels[i]], entry.channels[i]))
        liveliest = sorted(places, key=lambda i: -shares[i])
        telling.append(list(dict.fromkeys([*common[:_CHANNELS], *liveliest[:own_count]])))
    return telling


def _lively(entry: Sketch) -> list[float]:
    """Share of the time in which each channel is well off its last value, shape ``(channel,)``."""
    moved = np.abs(np.diff(entry.values, axis=0)) > _MOVES / 2
    return [float(share) for share in moved.mean(axis=0)] if len(moved) else [0.0] * len(entry.channels)


def _select_windows(windows: int) -> NDArray[np.int64]:
    """Return the first blocks of the searched windows, even and odd alternately."""
    every = np.arange(0, windows, _HOP)
    every[1::2] += 1
    return every[every < windows]


def _fingerprints(values: Floats, places: NDArray[np.int64]) -> tuple[Floats, NDArray[np.int64]]:
    """Return the fingerprints ``(window, 12)`` of those windows in which the channel moves, and where they begin.

    Args:
        values: blocks of a channel.
        places: start indices of the windows.
    """
    windows = np.lib.stride_tricks.sliding_window_view(values, WINDOW)[places]
    phase = np.pi * (np.arange(WINDOW) + 0.5) / WINDOW
    order = np.arange(1, _COEFFICIENTS + 1)
    basis = np.cos(np.outer(phase, order)) * np.sqrt(2.0 / WINDOW)
    marks = windows @ basis.astype(np.float32)
    # The channel's own deviation is one.
    moving_windows = np.flatnonzero(np.linalg.norm(marks, axis=1) > _MOVES * WINDOW**0.5)
    # Slow parts are large in every motion: as in a derivative, faster ones count for more.
    marks = marks[moving_windows] * order.astype(np.float32)
    return marks / np.linalg.norm(marks, axis=1, keepdims=True), places[moving_windows]


def _check_candidate(a: Sketch, b: Sketch, lag: int) -> Repeat | None:
    """Return the repeat at a lag (block k of `a` is block k + `lag` of `b`); None if the recordings differ."""
    if abs(a.hz - b.hz) > 1e-6:
        return None
    start = max(0, -lag)
    stop = min(len(a.values), len(b.values) - lag)
    count = (stop - start - 1) // WINDOW
    if count < 1:
        return None
    start += max(1 - (start + lag), 0)  # a fraction of a block is read before the first
    count = (stop - start - 1) // WINDOW
    pairs = _pairs(a, b, slice(start, stop), lag)
    if count < 1 or not pairs:
        return None
    mine = _windows(a.values[start : start + count * WINDOW, [i for i, _ in pairs]])
    columns = b.values[:, [j for _, j in pairs]]
    rows = np.arange(start + lag, start + lag + count * WINDOW)
    best: tuple[float, NDArray[np.float64]] | None = None
    for shift in _SHIFTS:
        theirs = _windows((1 - abs(shift)) * columns[rows] + abs(shift) * columns[rows + int(np.sign(shift))])
        alike = _alike(mine, theirs)
        score = float(np.nanmedian(alike)) if np.isfinite(alike).any() else -1.0
        if best is None or score > best[0]:
            best = (score, alike)
        if shift == 0.0 and float(np.mean(np.nan_to_num(alike) > _HOPELESS)) * alike.shape[0] < 1:
            return None
    return None if best is None else _compare_pair(a, b, lag, start, pairs, best[1])


def _compare_pair(
    a: Sketch, b: Sketch, lag: int, start: int, pairs: list[tuple[int, int]], alike: NDArray[np.float64]
) -> Repeat | None:
    """Return a repeat from the correlations ``(window, channel)``, with NaN for channels without motion."""
    moves = np.isfinite(alike)
    agree = np.where(moves, alike, 0.0) > _SAME
    moving = moves.sum(axis=1)
    same = agree.sum(axis=1) > _MIN_SHARE * moving
    if same.sum() < _MIN_WINDOWS:
        return None
    hit = np.flatnonzero(same)
    if len(hit) < _MIN_UNBROKEN * (moving[hit[0] : hit[-1] + 1] > 0).sum():
        return None
    compared = moves[hit].any(axis=0)
    agreeing_pairs = agree[hit].sum(axis=0) >= 0.5 * np.maximum(moves[hit].sum(axis=0), 1)
    if agreeing_pairs.sum() <= _MIN_SHARE * compared.sum():
        return None
    begins = start + int(hit[0]) * WINDOW
    ends = start + (int(hit[-1]) + 1) * WINDOW
    if int(hit[0]) == 0 or not moving[: int(hit[0])].any():
        begins = max(0, -lag)
    stop = min(len(a.values), len(b.values) - lag)
    if stop - ends < WINDOW:
        ends = stop
    apart = int((moving[hit[0] : hit[-1] + 1] > 0).sum()) - len(hit)
    shared = ends - begins - apart * WINDOW
    renamed = tuple(
        (a.channels[i], b.channels[j])
        for (i, j), agrees in zip(pairs, agreeing_pairs)
        if agrees and a.channels[i] != b.channels[j]
    )
    return Repeat(
        a.name,
        b.name,
        shared / a.hz,
        min(1.0, shared / min(len(a.values), len(b.values))),
        begins / a.hz,
        (begins + lag) / b.hz,
        int((agreeing_pairs & compared).sum()),
        int(compared.sum()),
        float(np.median(alike[hit][agree[hit]])),
        renamed,
        False,
    )


def _pairs(a: Sketch, b: Sketch, rows: slice, lag: int) -> list[tuple[int, int]]:
    """Return the columns of the same name, or where no name is shared, those that agree best at the lag, each once."""
    shared = [(i, b.channels.index(name)) for i, name in enumerate(a.channels) if name in b.channels]
    if shared:
        return shared
    mine, theirs = a.values[rows], b.values[rows.start + lag : rows.stop + lag]
    sizes = np.outer(mine.std(axis=0), theirs.std(axis=0))
    products = (mine - mine.mean(axis=0)).T @ (theirs - theirs.mean(axis=0)) / len(mine)
    alike = np.where(sizes > 1e-6, products / np.maximum(sizes, 1e-6), -1.0)
    pairs = []
    for _ in range(min(alike.shape)):
        i, j = (int(k) for k in np.unravel_index(int(np.argmax(alike)), alike.shape))
        if alike[i, j] < _SAME - 0.03:
            break
        pairs.append((i, j))
        alike[i, :], alike[:, j] = -1.0, -1.0
    return pairs


def _windows(values: Floats) -> NDArray[np.float64]:
    """Return the shape ``(window, sample, channel)``, each window about its mean."""
    windows = values.reshape(-1, WINDOW, values.shape[1]).astype(np.float64)
    centred: NDArray[np.float64] = windows - windows.mean(axis=1, keepdims=True)
    return centred


def _alike(mine: NDArray[np.float64], theirs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the correlation by window and channel, shape ``(window, channel)``; NaN where neither moves."""
    sizes = np.sqrt((mine**2).mean(axis=1)), np.sqrt((theirs**2).mean(axis=1))
    moves = np.maximum(*sizes) > _MOVES
    products = (mine * theirs).mean(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        alike = products / np.maximum(sizes[0] * sizes[1], 1e-12)
    return np.where(moves, alike, np.nan)
