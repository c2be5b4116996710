"""Twin as a controller model: its memory follows the measurement, and its error is monitored."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import AXES
from edp.control.plant import PILOTS, STROKES, VELOCITIES, PlantInterface
from edp.errors import ConfigError, closest
from edp.networks.twin import Twin
from edp.networks.twin.base import TwinState
from edp.networks.twin.disturbance_observer import DisturbanceObserver
from edp.wording import typed

Array = NDArray[np.float64]


class TwinModel:
    """Predictions of strokes and pressures for commands to come, corrected by what past predictions missed.

    At each tick the twin reads what was measured. Beside that it is asked what it would have said `window` ticks ago of
    now, told the commands that were given since. Per second of the window, that error is a speed: smoothed, it is the
    disturbance that every prediction is corrected by, so that no offset stays where the model is wrong.

    Args:
        twin: commanded by pilot pressures of Table A.1; outputs the strokes and velocities of three cylinders.
        plant: controlled plant.
        window: number of samples over which predictions are compared with measurements.
        smoothing: share of an error that the disturbance takes over in a tick; 0: no disturbance.
        load: the fraction for forces against the cylinders, if the twin has a load.

    Attributes:
        reads: channels of the plant that it reads, in the order of the twin's outputs.
        pressures: number of cylinder pressures that it predicts.
        disturbance: speeds (m/s), shape (3,), that the twin does not know of.

    Raises:
        ConfigError: another rate, other commands, or strokes or velocities that either does not have.
    """

    def __init__(self, twin: Twin, plant: PlantInterface, window: int, smoothing: float, load: float = 0.0) -> None:
        answers = [channel.name for channel in twin.channels.answers]
        commands = [channel.name for channel in twin.channels.commands]
        _check(twin, plant, answers, commands)
        measured = {channel.name for channel in plant.channels}
        self.twin, self.plant, self.window, self.smoothing = twin, plant, window, smoothing
        self._runner = twin.runner()
        self.reads = tuple(name for name in answers if name in measured)
        self._ports = np.array([answers.index(name) for name in self.reads])
        self._pilots = np.array([PILOTS.index(name) for name in commands])
        self._strokes = _columns([answers.index(name) for name in STROKES])
        velocities = np.array([answers.index(name) for name in VELOCITIES])
        self._velocities, self._load = velocities, DisturbanceObserver(self._runner, velocities, load)
        self._pressures = _columns([n for n, name in enumerate(answers) if name.startswith("CylPressures_")])
        self.pressures = sum(name.startswith("CylPressures_") for name in answers)
        self._free = np.full(len(answers), np.nan, np.float32)
        self.disturbance = np.zeros(AXES)
        self._state: TwinState = {}
        self._past: deque[tuple[TwinState, NDArray[np.float32], NDArray[np.float32]]] = deque(maxlen=window)
        self._alone = np.zeros(1, np.int64)

    @property
    def load(self) -> Array:
        """Forces (N) against boom, arm and bucket that were estimated, shape (3,); zero of a twin without a load."""
        forces = self._runner.resistance
        return np.zeros(AXES) if forces is None else np.asarray(forces[self._velocities])

    def begin(self, measured: Array) -> None:
        """Initialise the memory in steady state for this row of `reads` and neutral levers."""
        ticks = max(1, self.twin.prefix_ticks)
        command = np.asarray(self.plant.commands(np.zeros(AXES))[self._pilots], np.float32)
        row = self.row(measured)
        # What the plant does not measure starts at its mean.
        row = np.where(np.isfinite(row), row, self.twin.scales.answer_offset).astype(np.float32)
        rows = np.repeat(row[None, None], ticks, axis=1)
        self._state = self.twin.reset(np.repeat(command[None, None], ticks, axis=1), rows)
        self.disturbance = np.zeros(AXES)
        self._load.begin()
        self._past.clear()

    def row(self, measured: Array) -> NDArray[np.float32]:
        """Return one measured row of the channels `reads`; NaN for unmeasured or untrusted outputs."""
        row = self._free.copy()
        row[self._ports] = measured
        return row

    def look_back(self, measured: Array) -> None:
        """Bring disturbance and load up to date with this row of `reads`; where a stroke is NaN, its part stays."""
        self._load.update(self.row(measured)[self._velocities].astype(float))
        if len(self._past) < self.window or not self.smoothing:
            return
        state, row, _ = self._past[0]
        commands = np.array([command for _, _, command in self._past])
        answers = self._runner.neighbours(commands[None], state, row, self._alone)
        missed = self.row(measured)[self._strokes] - answers[0, -1, self._strokes]
        speed = missed * self.plant.rate_hz / self.window
        speed = np.where(np.isfinite(speed), speed, self.disturbance)
        self.disturbance = self.disturbance + self.smoothing * (speed - self.disturbance)

    def predicted(self, levers: Array, measured: Array, first: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return predictions for future levers.

        Args:
            levers: shape (run, tick, 3); those of a run the first one's before it branches off.
            measured: a row of `reads`, now.
            first: tick at which each run branches off the first one, shape (run,), ascending.

        Returns:
            Strokes (m) after each tick, shape (run, tick, 3), and cylinder pressures (Pa), shape (run, tick, pressure).
        """
        commands = np.asarray(self.plant.commands(levers)[..., self._pilots], np.float32)
        answers = self._runner.neighbours(commands, self._state, self.row(measured), first)
        ticks = np.arange(1, levers.shape[1] + 1)[:, None]
        strokes = answers[..., self._strokes] + ticks * (self.disturbance / self.plant.rate_hz)
        return strokes, answers[..., self._pressures].astype(float)

    def advance(self, measured: Array | None, levers: Array) -> None:
        """Advance by one sample with these levers; with `measured` None all ports run free."""
        row = self._free if measured is None else self.row(measured)
        command = np.asarray(self.plant.commands(levers)[self._pilots], np.float32)
        self._past.append((self._state, row, command))
        before = self._state
        self._state = self._runner.step(command, before, row)
        self._load.expect(command, row, before, self._state)


def _columns(indices: list[int]) -> slice | NDArray[np.int64]:
    """Return a slice for contiguous columns, which avoids a copy; otherwise an index array."""
    if indices and indices == list(range(indices[0], indices[-1] + 1)):
        return slice(indices[0], indices[-1] + 1)
    return np.array(indices, np.int64)


def _check(twin: Twin, plant: PlantInterface, answers: list[str], commands: list[str]) -> None:
    """Raise an error for a twin that does not fit the plant."""
    if twin.channels.rate_hz != plant.rate_hz:
        raise ConfigError(
            f"the twin has {typed(twin.channels.rate_hz)} Hz, {plant.source} {typed(plant.rate_hz)} Hz; train one "
            "at the rate of "
            "the loop"
        )
    for name in (*STROKES, *VELOCITIES):
        if name not in answers:
            raise ConfigError(
                f"the twin does not answer '{name}'{closest(name, answers)}; a controller needs strokes and velocities "
                "of boom, arm and bucket: train one on them"
            )
    for name in commands:
        if name not in PILOTS:
            raise ConfigError(f"the twin is commanded by '{name}', which no lever moves{closest(name, PILOTS)}")
    plant.columns((*STROKES, *VELOCITIES))
