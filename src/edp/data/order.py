"""Random order of more items than fit into memory as a list."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAX_LISTED = 1 << 24
"""Maximum number of items whose random order is stored as a list (8 bytes each, 128 MB), or 46 hours of windows at 100
Hz."""
ROUNDS = 6
"""Number of rounds of the Feistel network. Four rounds make the order indistinguishable from random for ideal functions
(Luby and Rackoff, 1988)."""
Numbers = NDArray[np.int64]


class RandomOrder:
    """Random permutation of ``range(count)``, computed on access.

    Up to `MAX_LISTED` items, NumPy computes the permutation. For more items, a Feistel network with random keys
    permutes the next power of four; numbers outside the range are permuted again until they are inside (cycle walking,
    Black and Rogaway 2002).

    Args:
        rng: random generator.
        count: length of the permutation.
    """

    def __init__(self, rng: np.random.Generator, count: int) -> None:
        self.count = count
        self._listed: Numbers | None = rng.permutation(count) if count <= MAX_LISTED else None
        self._bits = max(1, ((count - 1).bit_length() + 1) // 2)
        self._keys = rng.integers(1, 1 << 62, size=(ROUNDS, 2), dtype=np.uint64) if self._listed is None else None

    def __len__(self) -> int:
        return self.count

    def part(self, start: int, stop: int) -> Numbers:
        """Return the entries ``start:stop``, limited to the length."""
        stop = min(stop, self.count)
        if self._listed is not None:
            return self._listed[start:stop]
        numbers = self._permute(np.arange(start, stop, dtype=np.uint64))
        outside = numbers >= self.count
        while outside.any():
            numbers[outside] = self._permute(numbers[outside])
            outside = numbers >= self.count
        return numbers.astype(np.int64)

    def _permute(self, numbers: NDArray[np.uint64]) -> NDArray[np.uint64]:
        bits, mask = np.uint64(self._bits), np.uint64((1 << self._bits) - 1)
        left, right = numbers >> bits, numbers & mask
        for factor, offset in self._keys if self._keys is not None else ():
            # Multiplied by an odd number and shifted: the upper bits, which depend on all lower ones.
            mixed = (right + offset) * (factor | np.uint64(1))
            mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
            left, right = right, left ^ ((mixed >> np.uint64(32)) & mask)
        return (left << bits) | right
