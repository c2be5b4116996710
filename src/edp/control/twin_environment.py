"""A trained twin as a plant, with the interface of the simulator's environment: one argument exchanges them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import AXES, TipGeometry
from edp.control.plant import PILOTS, STROKES, VELOCITIES
from edp.errors import ConfigError, closest
from edp.networks.twin import Twin
from edp.signals import Channel
from edp.sim.environment import EnvironmentSpec, ExcavatorEnv
from edp.sim.environment.library import gymnasium
from edp.sim.machine.machine_files import load_machine

Array = NDArray[np.float64]
OPTIONS = ("strokes", "material")
"""Options of a reset; a twin knows no soil, so that ``material`` must be empty."""
MIDDLE = (0.5, 0.5, 0.5)
TIP = ("TipX", "TipY", "TipAngle")


class TwinEnvironment(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """An environment whose machine is a twin on commands alone.

    Levers become nominal pilot pressures, one tick of the twin answers them, and the observation holds its velocities,
    strokes and pressures and the pilot pressures, without noise. ``info["truth"]`` holds strokes and tip. Its memory
    forms in a prefix at rest, which the simulator's machine of the same name shows at the strokes of the start.

    Args:
        twin: of an excavator, with the channels of Table A.1 and strokes.
        machine: name or file of the machine whose kinematics, nominal commands and pressures at rest are used.
        duration_s: length of an episode.

    Attributes:
        channels: of an observation, in its order.
        rate_hz: ticks per second, those of the twin.
        machine: its numbers.

    Raises:
        ConfigError: the twin has no strokes, or channels that no excavator has.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  as Gymnasium declares it
    source = "the twin"

    def __init__(self, twin: Twin, machine: str, duration_s: float = 60.0) -> None:
        channels = twin.channels
        names = [channel.name for channel in (*channels.commands, *channels.answers)]
        lacking = [name for name in (*STROKES, *VELOCITIES) if name not in names]
        strange = [channel.name for channel in channels.commands if channel.name not in PILOTS]
        if lacking or strange:
            what = f"has no {lacking[0]}" if lacking else f"is commanded by '{strange[0]}'{closest(strange[0], PILOTS)}"
            raise ConfigError(
                f"the twin {what}; a plant in closed loop answers the velocities and strokes of an excavator to the "
                "pilot pressures of Table A.1: train it on such recordings"
            )
        self.twin, self.machine = twin, load_machine(machine)
        self.rate_hz, self.render_mode = channels.rate_hz, None
        self.channels: tuple[Channel, ...] = (*channels.answers, *channels.commands)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (len(self.channels),), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (AXES,), np.float32)
        self._geometry = TipGeometry(self.machine)
        self._command_columns = np.array([PILOTS.index(channel.name) for channel in channels.commands])
        self._stroke_columns = np.array([[c.name for c in channels.answers].index(name) for name in STROKES])
        self._ticks, self._tick = round(duration_s * channels.rate_hz), 0
        self._state: Any = None
        self._rest = ExcavatorEnv(
            EnvironmentSpec(
                machine=machine,
                duration_s=(twin.prefix_ticks + 2) / self.rate_hz,
                rate_hz=self.rate_hz,
                sensor_noise=False,
                observed=tuple(channel.name for channel in self.channels),
            )
        )
        self.commands = self._rest.commands

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode at rest.

        Args:
            seed: of the environment's own generator; a twin draws nothing.
            options: ``strokes``, shares of full to start from.

        Raises:
            ConfigError: an option is unknown, or a soil.
        """
        super().reset(seed=seed)
        chosen = dict(options or {})
        for name in chosen:
            if name not in OPTIONS:
                raise ConfigError(f"reset of a twin: option '{name}' is unknown{closest(name, OPTIONS)}")
        if chosen.get("material"):
            raise ConfigError(f"reset: material = '{chosen['material']}'; a twin knows no soil: choose another task")
        rows = self._prefix(chosen.get("strokes") or MIDDLE)
        answers, commands = rows[:, : len(self.twin.channels.answers)], rows[:, len(self.twin.channels.answers) :]
        self._state = self.twin.reset(commands[None, :-1], answers[None, :-1])
        self._tick = 0
        return self._shown(answers[-1], commands[-1])

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold lever positions, shape (3,), for one tick.

        Raises:
            ConfigError: they are not three finite numbers, or the environment was not reset.
        """
        levers = np.asarray(action, dtype=float)
        if levers.shape != (AXES,) or not np.isfinite(levers).all():
            raise ConfigError(f"levers {levers.tolist()}; give three finite positions: boom, arm and bucket")
        if self._state is None:
            raise ConfigError("the environment has no episode under way; call reset() before step()")
        command = self.commands(np.clip(levers, -1.0, 1.0))[self._command_columns].astype(np.float32)
        answer, self._state = self.twin.step(command[None], self._state)
        self._tick += 1
        observation, info = self._shown(answer[0], command)
        return observation, 0.0, False, self._tick >= self._ticks, info

    def _prefix(self, shares: Any) -> NDArray[np.float32]:
        """What the machine shows at rest, a row a tick: answers, then commands; one more row than the prefix."""
        options = {"strokes": tuple(map(float, shares))}
        rows = [self._rest.reset(seed=0, options=options)[0]]
        rows += [self._rest.step(np.zeros(AXES))[0] for _ in range(self.twin.prefix_ticks)]
        return np.array(rows, np.float32)

    def _shown(
        self, answer: NDArray[np.float32], command: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        strokes = answer[self._stroke_columns].astype(float)
        tip = self._geometry.tip(strokes)
        truth = dict(zip((*STROKES, *TIP), (*strokes.tolist(), *tip.tolist()), strict=True))
        return np.concatenate([answer, command]).astype(np.float32), {"truth": truth}
