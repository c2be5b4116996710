"""Covariances of all channels with each other at all lags, computed per segment in the frequency domain.

A segment is cut into blocks. The spectrum of a block, padded by the largest lag, times that of the segment around it
gives exactly the sums over its rows at all lags; blocks are added up before the way back. So all pairs at all lags cost
one matrix product a frequency.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from edp.data.screening.compiled import spread
from edp.data.screening.result import Array
from edp.data.screening.table import CandidateTable, Piece
from edp.recording import FloatArray

_SEGMENTS = 128
"""Number of blocks whose spectra are in memory at the same time."""


@dataclass(frozen=True, eq=False)
class Lagged:
    """Covariances of the live channels, each centred per segment and scaled to deviation 1 within segments.

    Attributes:
        live: columns of the table that the channels here are, ``(channel,)``.
        reach: largest lag.
        sums: sums of ``x_i[t + lag] x_j[t]`` over segment p, as ``[p, reach + lag, i, j]``, float32.
        samples: number of rows of each segment, ``(segment,)``.
        chance: correlations of channels with targets of other segments, ``(segment, shift, lag, channel, target)``.
    """

    live: NDArray[np.int64]
    reach: int
    sums: FloatArray
    samples: NDArray[np.int64]
    chance: FloatArray

    @property
    def lags(self) -> NDArray[np.int64]:
        """All lags, ``(lag,)``."""
        return np.arange(-self.reach, self.reach + 1)

    def pooled(self) -> Array:
        """Return the correlation over all segments, ``(lag, channel, channel)``."""
        sums = self.sums.sum(axis=0, dtype=np.float64)
        deviation = np.sqrt(np.diagonal(sums[self.reach]))
        sums /= np.outer(deviation, deviation)
        result: Array = sums
        return result

    def by_piece(self, columns: NDArray[np.int64]) -> FloatArray:
        """Return the correlation of all channels with some in each segment, ``(segment, lag, channel, column)``."""
        squares = self.squares()
        scale = np.sqrt(squares[:, None, :, None] * squares[:, None, None, columns])
        shown = self.sums[:, :, :, columns]
        result: FloatArray = np.divide(shown, scale, out=np.zeros_like(shown), where=scale > 0)
        return result

    def squares(self) -> FloatArray:
        """Return the sums of squares in each segment, ``(segment, channel)``."""
        return np.ascontiguousarray(np.diagonal(self.sums[:, self.reach], axis1=1, axis2=2))


class _Spectra:
    """Spectra of the blocks of one segment, without and with the neighbouring rows."""

    def __init__(self, table: CandidateTable, reach: int, live: NDArray[np.int64]) -> None:
        self.table, self.reach, self.live = table, reach, live
        # A power of two, at least eight times the reach: then a quarter of a block at most is padding.
        self.size = 1024
        while self.size < 8 * reach:
            self.size *= 2
        self.block = self.size - 2 * reach

    def scaled(self, piece_index: int) -> Iterator[FloatArray]:
        """Yield the parts of a segment, centred and scaled, ``(time, channel)``."""
        mean = self.table.sums[0][piece_index, self.live]
        deviation = self.table.within[self.live]
        for stretch in self.table.pieces[piece_index].stretches:
            # Single precision halves the memory of all pairs; `linear.RIDGE` covers its rounding errors.
            yield ((stretch[:, self.live] - mean) / deviation).astype(np.float32)

    def blocks(self, piece_index: int, columns: NDArray[np.int64] | None, around: bool) -> NDArray[np.complex64]:
        """Return the spectra of all blocks of a segment, ``(frequency, block, channel)``."""
        cut = []
        for values in self.scaled(piece_index):
            chosen = values if columns is None else values[:, columns]
            count = -(-len(chosen) // self.block)
            padded = np.zeros((self.reach + count * self.block + self.reach, chosen.shape[1]), dtype=np.float32)
            padded[self.reach : self.reach + len(chosen)] = chosen
            for i in range(count):
                part = padded[i * self.block : i * self.block + self.size]
                if not around:
                    part = part.copy()
                    # Zeros around the block keep the products of the circular transform apart from each other.
                    part[: self.reach] = part[-self.reach :] = 0.0
                cut.append(part)
        spectra = scipy.fft.rfft(np.stack(cut), axis=1)
        return np.ascontiguousarray(spectra.transpose(1, 0, 2), dtype=np.complex64)

    def back(self, product: NDArray[np.complex64]) -> FloatArray:
        """Transform summed cross spectra ``(frequency, i, j)`` to sums at lags -reach to reach."""
        flat = np.ascontiguousarray(product.reshape(len(product), -1).T)
        sums = scipy.fft.irfft(flat, n=self.size, axis=1)
        shown = np.concatenate([sums[:, -self.reach :], sums[:, : self.reach + 1]], axis=1)
        return np.asarray(shown.T.reshape(-1, *product.shape[1:]), dtype=np.float32)


def compute_lagged_covariances(
    table: CandidateTable, reach: int, shifts: int = 4, on_share: Callable[[float], None] | None = None
) -> Lagged:
    """Return the covariances of all pairs up to lag `reach`, and the level that chance produces between segments.

    Args:
        table: the data.
        reach: largest lag, samples.
        shifts: number of other segments with which each segment is paired to estimate the level of chance.
        on_share: callback with the completed fraction.
    """
    live = np.flatnonzero(table.live)
    spectra = _Spectra(table, reach, live)
    places = np.searchsorted(live, table.targets)
    count = len(table.pieces)
    shifts = min(shifts, count - 1)
    answers = [spectra.blocks(p, places, around=False) for p in range(count)]
    strengths = np.stack([_squares(table, p, live) for p in range(count)])

    def of_piece(p: int) -> tuple[FloatArray, FloatArray]:
        around = spectra.blocks(p, None, around=True)
        sums = spectra.back(_product(around, spectra.blocks(p, None, around=False)))
        pairs = []
        for shift in range(1, shifts + 1):
            # Channels of this segment with targets of another segment are unrelated and give the chance level.
            other = (p + shift) % count
            shared = min(around.shape[1], answers[other].shape[1])
            products = spectra.back(_product(around[:, :shared], answers[other][:, :shared]))
            share = shared / np.sqrt(around.shape[1] * answers[other].shape[1])
            scale = share * np.sqrt(np.outer(strengths[p], strengths[other][places]))
            pairs.append(np.divide(products, scale, out=np.zeros_like(products), where=scale > 0))
        return sums, np.stack(pairs).astype(np.float32)

    piece_covariances = spread(of_piece, range(count), on_share)
    rows = np.array([piece.samples for piece in table.pieces])
    return Lagged(
        live, reach, np.stack([s for s, _ in piece_covariances]), rows, np.stack([c for _, c in piece_covariances])
    )


def _product(left: NDArray[np.complex64], right: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """Cross spectra summed over blocks, ``(frequency, i, j)``."""
    total = np.zeros((left.shape[0], left.shape[2], right.shape[2]), dtype=np.complex64)
    for start in range(0, left.shape[1], _SEGMENTS):
        part = slice(start, start + _SEGMENTS)
        # Laid out in order: many small products take a third of the time so (journal).
        total += np.matmul(np.ascontiguousarray(left[:, part].transpose(0, 2, 1)), right[:, part].conj())
    return total


def _squares(table: CandidateTable, piece_index: int, live: NDArray[np.int64]) -> Array:
    """Return the sums of squares of the scaled channels of a segment, ``(channel,)``."""
    piece: Piece = table.pieces[piece_index]
    squares: Array = table.sums[1][piece_index, live] / np.square(table.within[live]) * piece.samples
    return squares
