"""Excitation in the loop: who moves the levers, and how. New ways of moving register in `EXCITATIONS`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from edp.registry import Registry

Array = NDArray[np.float64]
AXES = 3


class Excitation(Protocol):
    """Someone at the levers."""

    def block(self, strokes: Array) -> Array:
        """The next lever targets in [-1, 1], shape (samples, 3), given the present strokes (shares of full, (3,))."""
        ...


EXCITATIONS: Registry[Callable[[np.random.Generator, float], Excitation]] = Registry("excitation")
"""By name: a class taking a random generator and the command rate in Hz."""


def extend_probability(stroke: float, pull: float = 1.1) -> float:
    """Chance to extend next: more when retracted, so that the mean stroke stays near the middle."""
    return float(np.clip(0.5 + pull * (0.5 - stroke), 0.03, 0.97))


class AxisStream:
    """One lever: moves of random size, sign and length, with pauses between them.

    Its vigour changes every few moves, from careful positioning to full-lever work, so that a data set holds both.

    Args:
        rng: source of randomness.
        rate_hz: samples per second.
        pause: chance that a hold is a pause.
    """

    LEVELS = (0.15, 1.0)
    HOLD_S = (0.25, 1.6)
    VIGOUR = (0.2, 1.0)
    CHANGE = 0.1

    def __init__(self, rng: np.random.Generator, rate_hz: float, pause: float = 0.45) -> None:
        self._rng, self._rate, self._pause = rng, rate_hz, pause
        self._vigour = rng.uniform(*self.VIGOUR)

    def hold(self) -> int:
        """Length of the next hold in samples."""
        return max(1, round(self._rng.uniform(*self.HOLD_S) * self._rate))

    def move(self, stroke: float) -> float:
        """Lever position of a move."""
        if self._rng.random() < self.CHANGE:
            self._vigour = self._rng.uniform(*self.VIGOUR)
        sign = 1.0 if self._rng.random() < extend_probability(stroke) else -1.0
        low, high = self.LEVELS
        return sign * (low + (high - low) * self._vigour * self._rng.random())

    def next(self, stroke: float) -> tuple[float, int]:
        """Lever position and its length in samples: a pause or a move."""
        level = 0.0 if self._rng.random() < self._pause else self.move(stroke)
        return level, self.hold()


@EXCITATIONS.register("isolated")
class Isolated:
    """One cylinder at a time, with pauses."""

    def __init__(self, rng: np.random.Generator, rate_hz: float) -> None:
        self._rng = rng
        self._stream = AxisStream(rng, rate_hz, pause=0.2)
        self._axis = 0

    def block(self, strokes: Array) -> Array:
        """One move or pause of one axis; the axis changes with every second block on average."""
        if self._rng.random() < 0.5:
            self._axis = int(self._rng.integers(AXES))
        level, samples = self._stream.next(strokes[self._axis])
        targets = np.zeros((samples, AXES))
        targets[:, self._axis] = level
        return targets


@EXCITATIONS.register("combined")
class Combined:
    """Three independent levers."""

    def __init__(self, rng: np.random.Generator, rate_hz: float) -> None:
        self._streams = [AxisStream(rng, rate_hz) for _ in range(AXES)]
        self._levels = np.zeros(AXES)
        self._left = np.zeros(AXES, dtype=int)

    def block(self, strokes: Array) -> Array:
        """Levers up to the next change of any of them."""
        for i in range(AXES):
            if self._left[i] == 0:
                self._levels[i], self._left[i] = self._streams[i].next(strokes[i])
        samples = int(self._left.min())
        self._left -= samples
        return np.tile(self._levels, (samples, 1))


@EXCITATIONS.register("reversals")
class Reversals:
    """Fast sign flips every 0.15-0.6 s on one to three levers, in bursts with pauses between."""

    def __init__(self, rng: np.random.Generator, rate_hz: float) -> None:
        self._rng, self._rate = rng, rate_hz

    def block(self, strokes: Array) -> Array:
        """One burst of four to ten flips, then a pause."""
        rng = self._rng
        active = rng.random(AXES) < 0.5
        active[rng.integers(AXES)] = True
        towards = np.array([1.0 if rng.random() < extend_probability(s, 3.0) else -1.0 for s in strokes])
        pieces = []
        for flip in range(int(rng.integers(4, 11))):
            levels = rng.uniform(0.3, 1.0, AXES) * active * towards * (-1.0) ** flip
            pieces.append(np.tile(levels, (max(1, round(rng.uniform(0.15, 0.6) * self._rate)), 1)))
        pieces.append(np.zeros((max(1, round(rng.uniform(0.2, 1.0) * self._rate)), AXES)))
        return np.concatenate(pieces)


@EXCITATIONS.register("end_stops")
class EndStops:
    """Runs one cylinder into its cushion and stop, holds it there, and lets the others move in between."""

    def __init__(self, rng: np.random.Generator, rate_hz: float) -> None:
        self._rng, self._rate = rng, rate_hz
        self._stream = AxisStream(rng, rate_hz)
        self._runner, self._sign, self._pushed = 0, 1.0, 0

    def block(self, strokes: Array) -> Array:
        """A stretch of a run until the end is reached, a hold of 0.5-1 s there, then a short combined move."""
        rng = self._rng
        share = strokes[self._runner]
        reached = (share if self._sign > 0 else 1.0 - share) > 0.995
        if reached or self._pushed > 12:
            hold = np.zeros((round(rng.uniform(0.5, 1.0) * self._rate), AXES))
            hold[:, self._runner] = self._sign * rng.uniform(0.3, 0.8)
            move = np.tile([self._stream.next(s)[0] for s in strokes], (self._stream.hold(), 1))
            move[:, self._runner] = 0.0
            self._runner = int(rng.integers(AXES))
            self._sign = 1.0 if rng.random() < extend_probability(strokes[self._runner], 0.6) else -1.0
            self._pushed = 0
            return np.concatenate((hold, move))
        self._pushed += 1
        targets = np.zeros((round(0.4 * self._rate), AXES))
        targets[:, self._runner] = self._sign * rng.uniform(0.35, 1.0)
        return targets
