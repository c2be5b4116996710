"""A grey box for one machine tick by tick, with everything that does not change laid out for its compiled code."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.base import TwinRunner, TwinState
from edp.networks.twin.grey.correction import OutputBounds
from edp.networks.twin.grey.neighbours import NearPlan, run_near
from edp.networks.twin.scales import Array

if TYPE_CHECKING:
    from edp.networks.twin.greybox import GreyTwin

Doubles = NDArray[np.float64]
SINGLE_TICKS = 4
"""Number of samples of a plan with single steps. Later steps take two samples, where levers change block by block."""
LONGEST_S = 0.0205
"""Maximum length of a step over two samples, s: ten steps per period of the fastest load oscillation."""


def goes_twice(twin: GreyTwin) -> bool:
    """Return whether a step of a plan may go over two ticks behind the first `SINGLE_TICKS`."""
    return twin.time[1] == 1 and 2.0 * twin.time[0] <= LONGEST_S


class GreyRunner(TwinRunner):
    """See `TwinRunner`; states that it makes are in double precision.

    Args:
        twin: grey box to simulate.
        names: names of the state's parts, in the order of the compiled code.
    """

    def __init__(self, twin: GreyTwin, names: tuple[str, ...]) -> None:
        super().__init__(twin)
        self._grey, self._names, self._units = twin, names, twin.units
        wiring, units = twin.wiring, twin.units
        limits = (twin.scales.low / units, twin.scales.high / units, units)
        self._bounds = OutputBounds(*(np.ascontiguousarray(values, dtype=np.float64) for values in limits))
        self._program, self._machine = twin.program, twin.machine(twin.numbers)
        self._double = goes_twice(twin)
        self._speeds = np.array([speed for speed, _, _, _ in wiring.columns])
        self.resistance = np.zeros(len(wiring.columns))

    def branches(self, commands: Array, state: TwinState, measured: Array, first: NDArray[np.int64]) -> Array:
        if len(commands) > 1:
            return super().branches(commands, state, measured, first)
        return self._run(commands, state, measured, first)[0]

    def neighbours(self, commands: Array, state: TwinState, measured: Array, first: NDArray[np.int64]) -> Array:
        return self._run(commands, state, measured, first, SINGLE_TICKS)[0]

    def step(self, command: Array, state: TwinState, measured: Array) -> TwinState:
        answers, after = self._run(command[None, None], state, measured, np.zeros(1, np.int64))
        return {"answer": answers[0]} | {name: values[None] for name, values in zip(self._names, after, strict=True)}

    def _run(
        self,
        commands: Array,
        state: TwinState,
        measured: Array,
        first: NDArray[np.int64],
        single: int | None = None,
    ) -> tuple[Array, tuple[Doubles, ...]]:
        """Return outputs ``(run, tick, output)`` and the final state of the first run; see `run_near` for `single`."""
        ticks = commands.shape[1]
        now = tuple(np.array(state[name][0], np.float64, order="C") for name in self._names)
        answers = np.empty((*commands.shape[:2], len(self._units)))
        forces = np.zeros(len(self._speeds)) if self.resistance is None else self.resistance
        resistance = np.ascontiguousarray(1e-6 * forces[self._speeds])
        row = measured / self._units
        singles = ticks if single is None or not self._double else max(1, single)
        plan = NearPlan(self._grey.demands(commands), row, first, singles)
        run_near(self._program, self._machine, self._bounds, plan, now, resistance, answers)
        return answers, now
