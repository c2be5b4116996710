"""Test signals whose commands are flat to 4 Hz: three multisines around a pose that changes now and then."""

from __future__ import annotations

import numpy as np

from edp.sim.excitation.base import AXES, EXCITATIONS, Array, Excitation
from edp.sim.machine.machine import Machine
from edp.sim.view import View


@EXCITATIONS.register("broadband")
class Broadband(Excitation):
    """Multisine on all levers at once with equal amplitudes from `LOW_HZ` to `HIGH_HZ` and independent phases.

    A signal lasts `COURSE_S`, in which every sine completes whole periods; then phases, amplitudes and the target pose
    are drawn again. The phases with the lowest crest factor of `DRAWS` random sets are used, so that the signal power
    uses the range of the lever (Pintelon and Schoukens, System Identification, 2.3).
    """

    by_hand = False
    LOW_HZ, HIGH_HZ = 0.1, 4.5
    """Frequency range of the commands, Hz. The last half octave below the sensor bandwidth is reserved for the filters
    of the measurement."""
    COURSE_S = 10.0
    PEAK = (0.5, 0.95)
    """Range of the random peak of a lever command, as a fraction of the full lever. Smaller peaks would mostly stay
    within the dead band."""
    DRAWS = 16
    LEAN = 1.2
    """Lever command per stroke fraction of distance from the target pose. The gain is low, so that it adds no power
    above 0.2 Hz."""
    MAX_LEAN = 0.3
    POSES = (0.1, 0.9)
    """Target strokes, as fractions of the full stroke."""
    PIECE_S = 0.1

    def __init__(self, rng: np.random.Generator, rate_hz: float, machine: Machine) -> None:
        super().__init__(rng, rate_hz, machine)
        self._course = np.zeros((0, AXES))
        self._pose = np.full(AXES, 0.5)
        self._lean = np.zeros(AXES)
        self._done = 0

    def block(self, view: View) -> Array:
        """Return 0.1 s of the signal."""
        if self._done >= len(self._course):
            self._begin()
        count = min(max(1, round(self.PIECE_S * self._rate)), len(self._course) - self._done)
        asked = np.clip(self.LEAN * (self._pose - view.strokes), -self.MAX_LEAN, self.MAX_LEAN)
        # The correction follows the stroke with a lag of one second, because steps would add power at all frequencies.
        share = 1.0 - np.exp(-np.arange(1, count + 1)[:, None] / self._rate)
        leans = self._lean + (asked - self._lean) * share
        self._lean = leans[-1].copy()
        piece = self._course[self._done : self._done + count] + leans
        self._done += count
        return np.clip(piece, -1.0, 1.0)

    def _begin(self) -> None:
        """Draw another signal."""
        rng, samples = self._rng, max(1, round(self.COURSE_S * self._rate))
        seconds = np.arange(samples) / self._rate
        # Omit sines above the Nyquist limit; at low rates at least one sine remains.
        highest = min(self.HIGH_HZ, 0.4 * self._rate)
        lines = np.arange(1, max(1, int(highest * self.COURSE_S)) + 1) / self.COURSE_S
        lines = lines[lines >= min(self.LOW_HZ, lines[-1])]
        self._course = np.empty((samples, AXES))
        for axis in range(AXES):
            best, least = np.zeros(samples), np.inf
            for _ in range(self.DRAWS):
                phases = rng.uniform(0.0, 2.0 * np.pi, len(lines))
                wave = np.cos(2.0 * np.pi * seconds[:, None] * lines + phases).sum(axis=1)
                if (peak := float(np.abs(wave).max())) < least:
                    best, least = wave, peak
            self._course[:, axis] = best * (rng.uniform(*self.PEAK) / least)
            self._pose[axis] = rng.uniform(*self.POSES)
        self._done = 0

    def redraw(self, unused: int) -> None:
        """Continue the signal where it was cut, since the whole signal is the present action."""
        self._done -= unused
