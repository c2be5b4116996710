"""Test signals: amplitude-modulated pseudo-random steps and chirps, set to the machine's dead bands."""

from __future__ import annotations

import math

import numpy as np

from edp.sim.excitation.base import AXES, EXCITATIONS, Array, Excitation, Hold, extend_probability, held
from edp.sim.excitation.levers import dead_lever
from edp.sim.machine.machine import Machine
from edp.sim.view import View


@EXCITATIONS.register("aprbs")
class Aprbs(Excitation):
    """Steps between nine levels on all levers, with chirps on one lever in between.

    The levels are zero and four of each sign: just inside, just outside and well outside the dead band, and well open.
    A chirp rises from 0.05 to 5 Hz, 0.1-0.3 in amplitude, on a bias that keeps it beyond the dead band; its sign
    turns where the cylinder nears an end.
    """

    by_hand = False
    HOLD_S = (0.15, 2.5)
    LEVELS = (0.92, 1.2, 1.9)
    """Command levels in addition to zero and `TOP`, as multiples of the dead band."""
    TOP = (0.75, 0.65, 0.85)
    """Maximum command level of boom, arm and bucket."""
    CHIRP_HZ = (0.05, 5.0)
    CHIRP_S = (12.0, 25.0)
    CHIRP_SHARE = 0.35
    """Fraction of the time with chirps. A larger fraction did not make the spectrum of the commands flatter (journal).
    """
    PIECE_S = 0.1
    """Length of a chirp segment, s. The sign of a chirp must change soon after a cylinder comes near an end stop."""
    TURN = (0.22, 0.78)
    """Stroke fractions at which a chirp changes its direction."""

    def __init__(self, rng: np.random.Generator, rate_hz: float, machine: Machine) -> None:
        super().__init__(rng, rate_hz, machine)
        self._dead = dead_lever(machine)
        self._holds = [Hold(rng, rate_hz) for _ in range(AXES)]
        self._levels = np.zeros(AXES)
        self._chirp, self._sign = -1, 1.0
        self._time = self._length = self._amplitude = self._extra = 0.0
        self._until_chirp = self._draw_pause()

    def _draw_pause(self) -> float:
        """Return the seconds of steps before the next chirp."""
        mean = 0.5 * sum(self.CHIRP_S) * (1.0 - self.CHIRP_SHARE) / self.CHIRP_SHARE
        return float(self._rng.uniform(0.3, 1.7) * mean)

    def block(self, view: View) -> Array:
        """Return the levers up to the next step of any lever; 0.1 s at a time during a chirp."""
        if self._chirp < 0 and self._until_chirp <= 0.0:
            self._begin_chirp(view)
        for i, hold in enumerate(self._holds):
            if hold.left == 0:
                self._levels[i] = self._level(i, view.strokes[i])
                hold.start(*self.HOLD_S)
        samples = min(hold.left for hold in self._holds)
        if self._chirp >= 0:
            samples = min(samples, max(1, round(self.PIECE_S * self._rate)))
        for hold in self._holds:
            hold.spend(samples)
        targets = held(self._levels, samples)
        if self._chirp >= 0:
            targets[:, self._chirp] = self._sweep(samples, view.strokes[self._chirp])
        else:
            self._until_chirp -= samples / self._rate
        return targets

    def _level(self, axis: int, stroke: float) -> float:
        choice = int(self._rng.integers(9))
        # One level in nine is rest: steps from and to zero cross the dead band.
        if choice == 8:
            return 0.0
        sign = 1.0 if self._rng.random() < extend_probability(stroke, 2.0) else -1.0
        level_index = choice % 4
        return sign * (
            self.TOP[axis] if level_index == 3 else self.LEVELS[level_index] * self._dead[axis, 0 if sign > 0 else 1]
        )

    def _begin_chirp(self, view: View) -> None:
        rng = self._rng
        self._chirp = int(rng.integers(AXES))
        self._time, self._length = 0.0, float(rng.uniform(*self.CHIRP_S))
        self._amplitude, self._extra = float(rng.uniform(0.1, 0.3)), float(rng.uniform(0.02, 0.15))
        self._sign = 1.0 if view.strokes[self._chirp] < 0.5 else -1.0

    def _sweep(self, samples: int, stroke: float) -> Array:
        """Return the next samples of the chirp, exponential in frequency, so that every octave takes the same time."""
        low, high = self.CHIRP_HZ
        if (stroke > self.TURN[1] and self._sign > 0) or (stroke < self.TURN[0] and self._sign < 0):
            self._sign = -self._sign
        time = self._time + np.arange(samples) / self._rate
        growth = math.log(high / low) / self._length
        # The integral of the frequency; expm1 keeps its digits while growth * time is small.
        phase = 2.0 * np.pi * low * np.expm1(growth * time) / growth
        bias = self._dead[self._chirp, 0 if self._sign > 0 else 1] + self._amplitude + self._extra
        values = self._sign * (bias + self._amplitude * np.sin(phase))
        self._time += samples / self._rate
        if self._time >= self._length:
            self._chirp, self._until_chirp = -1, self._draw_pause()
        return np.asarray(values)

    def redraw(self, unused: int) -> None:
        """Redraw the duration of the present steps; a chirp continues where it was cut."""
        for hold in self._holds:
            hold.redraw(unused)
        if self._chirp >= 0:
            self._time -= unused / self._rate
