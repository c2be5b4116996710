"""Common base of excitations: registry, drift towards mid stroke, and holds of random duration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edp.registry import Registry
from edp.sim.machine.machine import Machine
from edp.sim.view import View

Array = NDArray[np.float64]
AXES = 3
MOTORS = 3


class Excitation:
    """Generator of lever commands; subclasses implement `block` and register in `EXCITATIONS`.

    The state of a subclass may only contain numbers, arrays, lists of them, random generators, or objects of these
    created in its constructor, so that a snapshot can store it.

    Attributes:
        by_hand: whether targets pass through an operator's hand; False for test signals and automatic control.
        works_ground: whether the excitation works the soil; all others always move in free air.
        swings: whether it moves swing and travel, too, of a machine that has their motors.
    """

    by_hand: bool = True
    works_ground: bool = False
    swings: bool = False

    def __init__(self, rng: np.random.Generator, rate_hz: float, machine: Machine) -> None:
        self._rng, self._rate, self._machine = rng, rate_hz, machine

    @classmethod
    def levers(cls) -> int:
        """Return how many levers it moves: boom, arm, bucket, and where it swings also swing, left and right track."""
        return AXES + MOTORS if cls.swings else AXES

    def block(self, view: View) -> Array:
        """Return the next lever targets in [-1, 1], shape (samples, `levers`), for the present view."""
        raise TypeError(f"{type(self).__name__} does not say what it does next; give it a `block`")

    def redraw(self, unused: int) -> None:
        """Discard the last `unused` samples of the latest block, and redraw the duration of the present action.

        A branch of a simulation calls this method. The operator's current action continues; its remaining duration is
        drawn again, conditional on the elapsed time.
        """


EXCITATIONS: Registry[type[Excitation]] = Registry("excitation")
"""Excitations by name, built from a random generator, the command rate in Hz and the machine."""


def extend_probability(stroke: float, pull: float = 1.1) -> float:
    """Return the chance to extend next: more when retracted, so that the mean stroke stays near the middle."""
    # The probability stays below one, so that the data include moves to the ends of the stroke.
    return min(max(0.5 + pull * (0.5 - stroke), 0.03), 0.97)


def held(levels: Sequence[float] | Array, samples: int) -> Array:
    """Return constant levers, shape (samples, levers)."""
    targets = np.empty((samples, len(levels)))
    targets[:] = levels
    return targets


class Hold:
    """Timer with a uniformly random duration.

    Attributes:
        left: samples left.
    """

    def __init__(self, rng: np.random.Generator, rate_hz: float) -> None:
        self._rng, self._rate = rng, rate_hz
        self._low = self._high = 0.0
        self._held = 0
        self.left = 0

    def start(self, low_s: float, high_s: float) -> int:
        """Start a duration between `low_s` and `high_s` seconds, and return its number of samples."""
        self._low, self._high, self._held = low_s, high_s, 0
        self.left = max(1, round(self._rng.uniform(low_s, high_s) * self._rate))
        return self.left

    def spend(self, samples: int) -> int:
        """Let `samples` pass."""
        self.left -= samples
        self._held += samples
        return samples

    def redraw(self, unused: int) -> None:
        """Return `unused` samples and redraw the remaining duration, given the elapsed time."""
        self.spend(-unused)
        if self.left > 0:
            # The total duration is at least the elapsed duration.
            low = max(self._low, self._held / self._rate)
            self.left = max(1, round(self._rng.uniform(low, max(low, self._high)) * self._rate) - self._held)


class AxisStream:
    """One lever: moves of random size, sign and length, with pauses between them.

    Its vigour changes every few moves, from careful positioning to full-lever work, so that a data set holds both.
    The boom is held long, arm and bucket are pulsed: fitted to the lags and spreads of the thesis's signals.

    Args:
        rng: source of randomness.
        rate_hz: samples per second.
        pause: chance that a hold is a pause.
        axis: index of the cylinder, whose speed and range are used; None for no cylinder.

    Attributes:
        axis: index of the cylinder; a stream may change it.
        level: lever position now.
        hold: remaining duration of the move, in samples.
    """

    LEVELS = (0.15, 1.0)
    HOLD_S = (0.25, 1.6)
    PACE = (1.0, 0.3, 0.15)
    STRENGTH = (0.75, 0.75, 1.2)
    VIGOUR = (0.2, 0.9)
    CHANGE = 0.1

    def __init__(self, rng: np.random.Generator, rate_hz: float, pause: float = 0.45, axis: int | None = None) -> None:
        self._rng, self._pause, self.axis = rng, pause, axis
        self._vigour = rng.uniform(*self.VIGOUR)
        self.level = 0.0
        self.hold = Hold(rng, rate_hz)

    def move(self, stroke: float) -> float:
        """Return the lever position of a move."""
        if self._rng.random() < self.CHANGE:
            self._vigour = self._rng.uniform(*self.VIGOUR)
        sign = 1.0 if self._rng.random() < extend_probability(stroke) else -1.0
        low, high = self.LEVELS
        strength = 1.0 if self.axis is None else self.STRENGTH[self.axis]
        return sign * (low + (high - low) * min(strength * self._vigour, 1.0) * self._rng.random())

    def next(self, stroke: float) -> None:
        """Take a new lever position and its length: a pause or a move."""
        self.level = 0.0 if self._rng.random() < self._pause else self.move(stroke)
        shortest, longest = self.HOLD_S
        pace = 1.0 if self.axis is None else self.PACE[self.axis]
        self.hold.start(pace * shortest, pace * longest)
