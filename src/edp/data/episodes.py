"""Episodes for meta-learning: segments of a machine for adaptation, and others to evaluate the adapted network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from edp.data.chunks import Batch, ChunkSpec, Piece, cut, stack
from edp.data.series import Series
from edp.errors import ConfigError, DataError


class EpisodeSampler:
    """Batches of episodes as a pure function of (seed, epoch). Each epoch uses every machine about once.

    A batch consists of ``machines`` groups of ``2 * shots`` segments of ``spec.length`` samples, each from reset. The
    first half of a group is the support set, on which a network adapts; the second half is the query set. The halves
    have no common samples.

    Args:
        series: training segments with a machine name.
        horizons: look-ahead samples.
        spec: length of a segment, batch size and burn-in.
        shots: number of support segments and of query segments per machine.
        seed: random seed of the order.

    Raises:
        ConfigError: windows, a batch that is no multiple of ``2 * shots``, or segments no longer than the burn-in.
        DataError: a series without a machine, or a machine with too few ticks for an episode.
    """

    def __init__(
        self, series: Sequence[Series], horizons: Sequence[int], spec: ChunkSpec, shots: int, seed: int
    ) -> None:
        self.series, self.horizons, self.spec = list(series), tuple(horizons), spec
        self.shots, self.seed = shots, seed
        if spec.regime != "chunk" or shots < 1 or spec.batch % (2 * shots) or spec.length <= spec.burn_in:
            raise ConfigError(
                f"episodes: regime = '{spec.regime}', length = {spec.length}, burn_in = {spec.burn_in}, batch = "
                f"{spec.batch}, shots = {shots}; chunks longer than the burn-in and a batch that is a multiple of "
                "2 * shots must hold"
            )
        self.machines = spec.batch // (2 * shots)
        self.owned = group_by_machine(self.series)
        needed = 2 * shots
        for machine, places in self.owned.items():
            piece_count = sum(self._pieces(self.series[series_index], 0) for series_index in places)
            if piece_count < needed:
                raise DataError(
                    f"machine '{machine}' has {sum(self.series[i].samples for i in places)} ticks, enough for "
                    f"{piece_count} pieces of {spec.length}; an episode needs {needed}: give longer recordings, "
                    "fewer shots "
                    "or a smaller training.chunks.length"
                )

    def updates(self, number: int = 0) -> int:
        """Return the number of batches of an epoch."""
        return -(-len(self.owned) // self.machines)

    def epoch(self, number: int) -> Iterator[Batch]:
        """Yield the batches of epoch `number`. The last batch is filled with machines from the beginning."""
        rng = np.random.default_rng([self.seed, number])
        names = list(self.owned)
        order = [names[i] for i in rng.permutation(len(names))]
        for first in range(0, len(order), self.machines):
            group = [order[(first + i) % len(order)] for i in range(self.machines)]
            rows = [piece for machine in group for piece in self._episode(machine, rng)]
            yield stack(rows, [True] * len(rows))

    def _pieces(self, part: Series, offset: int) -> int:
        """Return the number of segments in a series from `offset`; the loss covers all samples after the burn-in."""
        return max(0, (part.samples - offset - max(self.horizons)) // self.spec.length)

    def _episode(self, machine: str, rng: np.random.Generator) -> list[Piece]:
        places = self.owned[machine]
        offsets = rng.integers(0, self.spec.length, len(places))  # cut elsewhere in each episode
        starts = self._starts(places, offsets)
        if len(starts) < 2 * self.shots:  # all segments of this machine are needed
            starts = self._starts(places, np.zeros_like(offsets))
        chosen = [starts[i] for i in rng.permutation(len(starts))[: 2 * self.shots]]
        length, burn_in = self.spec.length, self.spec.burn_in
        return [cut(self.series[i], range(at, at + length), self.horizons, burn_in) for i, at in chosen]

    def _starts(self, places: Sequence[int], offsets: NDArray[np.int64]) -> list[tuple[int, int]]:
        return [
            (series_index, int(offset) + n * self.spec.length)
            for series_index, offset in zip(places, offsets, strict=True)
            for n in range(self._pieces(self.series[series_index], int(offset)))
        ]


def group_by_machine(series: Sequence[Series]) -> dict[str, list[int]]:
    """Return the indices of the series of each machine, in the order of the machines' first occurrence.

    Raises:
        DataError: a series without a machine name.
    """
    owned: dict[str, list[int]] = {}
    for series_index, part in enumerate(series):
        if not part.machine:
            raise DataError(
                f"recording '{part.name}' does not say which machine it is of; list the logs in a data-set file "
                '(.toml) with machine = "..." in each [[recordings]]'
            )
        owned.setdefault(part.machine, []).append(series_index)
    return owned
