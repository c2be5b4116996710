"""A trained twin as a plant, with the interface of the simulator's environment: one argument exchanges them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import AXES, TipGeometry
from edp.control.plant import PILOTS, STROKES
from edp.control.rest import RestingMachine, check_plant_channels
from edp.errors import ConfigError, closest
from edp.networks.twin import Twin, TwinState
from edp.networks.twin.grey.ground import GroundedRunner, GroundLaw
from edp.signals import Channel
from edp.sim.environment.library import gymnasium

Array = NDArray[np.float64]
OPTIONS = ("strokes", "material")
"""Options of a reset; ``material`` must be empty but for a twin with a ground."""
MIDDLE = (0.5, 0.5, 0.5)
TIP = ("TipX", "TipY", "TipAngle")


class TwinStart:
    """Conversion of a twin to a plant: channels, mapping from levers to commands, and initial state.

    Args:
        twin: of an excavator, with the channels of Table A.1 and strokes.
        machine: name or file of the machine whose kinematics, nominal commands and pressures at rest are used.

    Attributes:
        channels: of a row: answers, then commands.
        machine: its numbers.
        commands: nominal pilot pressures of levers.
        strokes: columns of the strokes in a row.

    Raises:
        ConfigError: the twin has no strokes, or channels that no excavator has.
    """

    def __init__(self, twin: Twin, machine: str) -> None:
        channels, self._twin = twin.channels, twin
        answers, commands = ([channel.name for channel in part] for part in (channels.answers, channels.commands))
        check_plant_channels("the twin", commands, answers, "train it on such recordings")
        self.channels: tuple[Channel, ...] = (*channels.answers, *channels.commands)
        self.strokes = np.array([answers.index(name) for name in STROKES])
        self._answers, self._columns = len(answers), np.array([PILOTS.index(name) for name in commands])
        self._rest = RestingMachine(machine, (*answers, *commands), channels.rate_hz, twin.prefix_ticks)
        self.machine, self.commands = self._rest.machine, self._rest.commands

    def begin(self, shares: Any) -> tuple[TwinState, NDArray[np.float32]]:
        """Return the steady state at the given strokes (fractions of full stroke) and its measurement row."""
        rows = self._rest.rows(shares)
        state = self._twin.reset(rows[None, :-1, self._answers :], rows[None, :-1, : self._answers])
        return state, rows[-1]

    def pilots(self, levers: Array) -> NDArray[np.float32]:
        """Commands of the twin, shape (..., command), of levers, shape (..., 3)."""
        pressures = self.commands(np.clip(levers, -1.0, 1.0))
        return np.asarray(pressures[..., self._columns], np.float32)


class TwinEnvironment(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """An environment whose machine is a twin on commands alone.

    Levers become nominal pilot pressures, one tick of the twin answers them, and the observation holds its velocities,
    strokes and pressures and the pilot pressures, without noise. ``info["truth"]`` holds strokes and tip. Its memory
    forms in a prefix at rest, which the simulator's machine of the same name shows at the strokes of the start.

    Args:
        twin: of an excavator, with the channels of Table A.1 and strokes.
        machine: name or file of the machine whose kinematics, nominal commands and pressures at rest are used.
        duration_s: length of an episode.
        ground: law of the ground that acts where a reset names a material; it stands for any.

    Attributes:
        channels: of an observation, in its order.
        rate_hz: ticks per second, those of the twin.
        machine: its numbers.

    Raises:
        ConfigError: the twin has no strokes, channels that no excavator has, or cannot stand on a ground.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  as Gymnasium declares it
    source = "the twin"

    def __init__(self, twin: Twin, machine: str, duration_s: float = 60.0, ground: GroundLaw | None = None) -> None:
        self._start = TwinStart(twin, machine)
        self.twin, self.machine, self.commands = twin, self._start.machine, self._start.commands
        self.rate_hz, self.render_mode = twin.channels.rate_hz, None
        self.channels = self._start.channels
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (len(self.channels),), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (AXES,), np.float32)
        self._geometry = TipGeometry(self.machine)
        self._ticks, self._tick = round(duration_s * self.rate_hz), 0
        self._state: Any = None
        self._grounded = None if ground is None else GroundedRunner(twin, ground)
        self._digs, self._free = False, np.full(len(twin.channels.answers), np.nan, np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, object]]:
        """Begin an episode in steady state.

        Args:
            seed: of the environment's own generator; a twin draws nothing.
            options: ``strokes``, shares of full to start from; ``material``: of a twin with a ground, any name lets
                it act, uncut.

        Raises:
            ConfigError: an option is unknown, or a soil where the twin has no ground.
        """
        super().reset(seed=seed)
        chosen = dict(options or {})
        for name in chosen:
            if name not in OPTIONS:
                raise ConfigError(f"reset of a twin: option '{name}' is unknown{closest(name, OPTIONS)}")
        if self._grounded is None:
            check_air(chosen.get("material"))
        else:
            self._digs = bool(chosen.get("material"))
            self._grounded.begin()
        self._state, row = self._start.begin(chosen.get("strokes") or MIDDLE)
        self._tick = 0
        return row, self._info(row)

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, object]]:
        """Hold lever positions, shape (3,), for one tick.

        Raises:
            ConfigError: they are not three finite numbers, or the environment was not reset.
        """
        levers = np.asarray(action, dtype=float)
        if levers.shape != (AXES,) or not np.isfinite(levers).all():
            raise ConfigError(f"levers {levers.tolist()}; give three finite positions: boom, arm and bucket")
        if self._state is None:
            raise ConfigError("the environment has no episode under way; call reset() before step()")
        command = self._start.pilots(levers)
        answer = self._advance(command)
        self._tick += 1
        row = np.concatenate([answer, command]).astype(np.float32)
        return row, 0.0, False, self._tick >= self._ticks, self._info(row)

    def _advance(self, command: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the output for a command, and advance the state."""
        if self._grounded is not None and self._digs:
            self._state = self._grounded.step(command, self._state, self._free)
            return np.asarray(self._state["answer"][0], np.float32)
        answer, self._state = self.twin.step(command[None], self._state)
        return np.asarray(answer[0], np.float32)

    def _info(self, row: NDArray[np.float32]) -> dict[str, object]:
        strokes = row[self._start.strokes].astype(float)
        tip = self._geometry.tip(strokes)
        return {"truth": dict(zip((*STROKES, *TIP), (*strokes.tolist(), *tip.tolist()), strict=True))}


def check_air(material: Any, what: str = "a twin") -> None:
    """Raise ConfigError for a soil in a plant without soil.

    Raises:
        ConfigError: there is one.
    """
    if material:
        raise ConfigError(
            f"reset: material = '{material}'; {what} knows no soil: choose another task, or material = ''"
        )
