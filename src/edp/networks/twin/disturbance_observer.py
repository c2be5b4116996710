"""Forces on the machine that its model does not know of, as soil makes them, from velocities that were measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.base import TwinRunner, TwinState

Array = NDArray[np.float64]
PROBE_N = 1e4
"""Force step for the numerical derivative of the next velocities by a force, N."""
RENEWED_TICKS = 10
"""Interval at which the effect of a force on the velocities is computed again, in samples. The effect depends on the
pose and on the valve openings."""
LOG_SHARE = 0.3
"""Fraction of a new error used for the force estimates along a recording, which may be noisier than in real-time
operation."""
MOST_N = 5e5
"""Maximum magnitude of an estimated force, N: about the holding force of a cylinder of a 22 t excavator."""


def force_slopes(
    runner: TwinRunner,
    velocities: NDArray[np.int64],
    tick: tuple[NDArray[np.float32], NDArray[np.float32], TwinState],
    expected: Array,
) -> Array:
    """Return the slopes of velocities after a tick by forces against them, m/s by N ``(velocity, velocity)``.

    Args:
        runner: runner of a model with a load; its `resistance` is restored.
        velocities: columns of its outputs.
        tick: command, row that its ports read, and state before it.
        expected: the velocities with its present resistance.
    """
    (command, row, before), resistance = tick, runner.resistance
    slopes = np.zeros((len(velocities), len(velocities)))
    if resistance is None:
        return slopes
    for axis, which in enumerate(velocities):
        runner.resistance = resistance + PROBE_N * (np.arange(len(resistance)) == which)
        moved = runner.step(command, before, row)["answer"][0, velocities]
        slopes[:, axis] = (moved - expected) / PROBE_N
    runner.resistance = resistance
    return slopes


class DisturbanceObserver:
    """External force against each cylinder, estimated from one-step-ahead velocity errors.

    Within one sample the chambers are nearly incompressible, so a velocity error of the model is attributed to an
    external force. Errors of the modelled friction or gravity are also attributed to this force.

    Args:
        runner: runner of a model with a load; the observer writes its `resistance`.
        velocities: column indices of the velocities among the outputs; velocities are the first outputs.
        share: fraction of a new error that the estimate adopts per sample; 0 to switch the observer off.
    """

    def __init__(self, runner: TwinRunner, velocities: NDArray[np.int64], share: float) -> None:
        self._runner, self._velocities, self._share = runner, velocities, share
        self._slopes, self._age = np.zeros((len(velocities), len(velocities))), 0
        self._expected: Array | None = None
        self._acts = share > 0.0 and runner.resistance is not None
        self.begin()

    def begin(self) -> None:
        """Reset the estimate."""
        self._expected, self._age = None, 0
        if self._runner.resistance is not None:
            self._runner.resistance = np.zeros_like(self._runner.resistance)

    def expect(
        self, command: NDArray[np.float32], row: NDArray[np.float32], before: TwinState, after: TwinState
    ) -> None:
        """Store the model's prediction of a sample.

        Args:
            command: command of the sample ``(command,)``.
            row: feedback inputs of the sample ``(output,)``.
            before: state before it.
            after: state after it.
        """
        resistance = self._runner.resistance
        if not self._acts or resistance is None:
            return
        self._expected = np.asarray(after["answer"][0, self._velocities], float)
        if self._age % RENEWED_TICKS == 0:
            self._slopes = force_slopes(self._runner, self._velocities, (command, row, before), self._expected)
        self._age += 1

    def update(self, measured: Array) -> None:
        """Update the estimate with measured velocities; NaN leaves the estimate unchanged."""
        resistance, expected = self._runner.resistance, self._expected
        if expected is None or resistance is None or not np.isfinite(measured).all():
            return
        try:
            forces = np.linalg.solve(self._slopes, measured - expected)
        except np.linalg.LinAlgError:
            return
        if np.isfinite(forces).all():
            changed = resistance.copy()
            changed[self._velocities] += self._share * forces
            self._runner.resistance = np.clip(changed, -MOST_N, MOST_N)
