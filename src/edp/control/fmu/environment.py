"""An FMU as a plant, with the interface of the simulator's environment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.control.fmu.archive import FmuArchive
from edp.control.fmu.description import FmuDescription, read_description
from edp.control.fmu.instance import FmuInstance
from edp.control.fmu.ports import ports_of
from edp.control.geometry import AXES, TipGeometry
from edp.control.plant import PILOTS, STROKES
from edp.control.rest import RestingMachine
from edp.control.twin_environment import MIDDLE, OPTIONS, TIP, check_air
from edp.errors import ConfigError, closest
from edp.sim.environment.library import gymnasium
from edp.sim.scenario import SimulationError
from edp.wording import setting_text, typed

Array = NDArray[np.float64]
REST_S = 2.0
"""Rest before the prefix, in which the memory of a twin forgets where a reset left it: at the means of its data."""
START_SHARE = 0.02
"""Share of a stroke by which an FMU may begin elsewhere than asked."""
STEP_SLACK = 1e-6


class FmuEnvironment(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """An environment whose machine is an FMU for co-simulation, of version 2.0 or 3.0.

    Levers become nominal pilot pressures; the observation holds the answers of the FMU and these. It begins at the
    strokes of the task in one of three ways: by measured values (``CylVels_1`` and ``CylVels_1_measured``, as exported
    twins have them), by parameters ``CylStroke_1_start``, or where it begins by itself, if that is there.

    Its library is native code that runs in this process with the rights of its user.

    Args:
        path: the file.
        machine: name or file of the machine whose kinematics, nominal commands and pressures at rest are used.
        duration_s: length of an episode.
        rate_hz: ticks per second.

    Attributes:
        channels: of an observation, in its order.
        rate_hz: ticks per second.
        machine: its numbers.

    Raises:
        ConfigError: FMPy is not installed, there is no such file, or it is no excavator, or of another rate.
        DataError: it is damaged, hostile, or without a library for this computer.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  as Gymnasium declares it
    source = "the FMU"

    def __init__(self, path: str | Path, machine: str, duration_s: float, rate_hz: float) -> None:
        archive = FmuArchive(path)
        self._where = f"FMU '{archive.path}'"
        description = read_description(archive.description(), self._where)
        self._ports = ports_of(description, self._where)
        _check_step(description, rate_hz, self._where)
        self.rate_hz, self.render_mode = rate_hz, None
        self.channels = (*self._ports.answers, *self._ports.commands)
        names = [channel.name for channel in self.channels]
        self._strokes = np.array([names.index(name) for name in STROKES])
        self._pilots = np.array([PILOTS.index(channel.name) for channel in self._ports.commands])
        window = description.window or round(rate_hz)
        self._rest = RestingMachine(machine, names, rate_hz, window)
        self.machine, self.commands = self._rest.machine, self._rest.commands
        self._geometry = TipGeometry(self.machine)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (len(self.channels),), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (AXES,), np.float32)
        self._ticks, self._tick, self._elapsed, self._begun = round(duration_s * rate_hz), 0, 0, False
        self._fmu = FmuInstance(archive, description)

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, object]]:
        """Begin an episode in steady state.

        Args:
            seed: of the environment's own generator; nothing is drawn.
            options: ``strokes``, shares of full to start from.

        Raises:
            ConfigError: an option is unknown, or a soil, or the FMU begins elsewhere.
            SimulationError: it refuses a call.
        """
        super().reset(seed=seed)
        chosen = dict(options or {})
        for name in chosen:
            if name not in OPTIONS:
                raise ConfigError(f"reset of an FMU: option '{name}' is unknown{closest(name, OPTIONS)}")
        check_air(chosen.get("material"), "an FMU")
        shares = chosen.get("strokes") or MIDDLE
        self._tick = self._elapsed = 0
        row = self._begin_with_measurements(shares) if self._ports.measured[0] else self._begin_with_parameters(shares)
        self._begun = True
        return row, self._info(row)

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, object]]:
        """Hold lever positions, shape (3,), for one tick.

        Raises:
            ConfigError: they are not three finite numbers, or the environment was not reset.
            SimulationError: the FMU refuses the step, or answers something that is not finite.
        """
        levers = np.asarray(action, dtype=float)
        if levers.shape != (AXES,) or not np.isfinite(levers).all():
            raise ConfigError(f"levers {levers.tolist()}; give three finite positions: boom, arm and bucket")
        if not self._begun:
            raise ConfigError("the environment has no episode under way; call reset() before step()")
        pilots = self.commands(np.clip(levers, -1.0, 1.0))[self._pilots].astype(np.float32)
        self._fmu.put(self._ports.inputs, pilots.tolist())
        self._go()
        self._tick += 1
        row = self._read_outputs(pilots)
        return row, 0.0, False, self._tick >= self._ticks, self._info(row)

    def close(self) -> None:
        """Free the FMU; afterwards it cannot run."""
        self._fmu.close()
        self._begun = False

    def _begin_with_measurements(self, shares: Any) -> NDArray[np.float32]:
        """Begin with measured values: a steady phase, then the prefix that initialises a twin's memory."""
        rows = self._rest.rows(shares)
        values, flags = self._ports.measured
        self._fmu.begin()
        self._fmu.put(flags, [1.0] * len(flags))
        before = np.repeat(rows[:1], round(REST_S * self.rate_hz), axis=0)
        for row in np.concatenate([before, rows[:-1]]).tolist():
            self._fmu.put((*values, *self._ports.inputs), row)
            self._go()
        self._fmu.put(flags, [0.0] * len(flags))
        return np.asarray(rows[-1])

    def _begin_with_parameters(self, shares: Any) -> NDArray[np.float32]:
        """Begin by parameters, or where the FMU begins."""
        asked_m = np.array([float(share) for share in shares]) * self._geometry.full_m
        self._fmu.begin(self._ports.starts, asked_m.tolist() if self._ports.starts else ())
        neutral = self.commands(np.zeros(AXES))[self._pilots].astype(np.float32)
        self._fmu.put(self._ports.inputs, neutral.tolist())
        row = self._read_outputs(neutral)
        apart = np.abs(row[self._strokes] - asked_m) / self._geometry.full_m
        if apart.max() > START_SHARE:
            axis = int(np.argmax(apart))
            raise ConfigError(
                f"{self._where} begins with {STROKES[axis]} at {row[self._strokes][axis]:.3f} m, the task at "
                f"{asked_m[axis]:.3f} m, and it has no parameters CylStroke_1_start to 3 that it heeds; give it such "
                "parameters, or start tasks where it begins"
            )
        return row

    def _go(self) -> None:
        self._fmu.step(self._elapsed / self.rate_hz, 1.0 / self.rate_hz)
        self._elapsed += 1

    def _read_outputs(self, pilots: NDArray[np.float32]) -> NDArray[np.float32]:
        answers = np.array(self._fmu.read(self._ports.outputs))
        if not np.isfinite(answers).all():
            name = self.channels[int(np.argmin(np.isfinite(answers)))].name
            raise SimulationError(f"{self._where} answers '{name}' = {answers.min()} after {self._tick} ticks")
        return np.concatenate([answers, pilots]).astype(np.float32)

    def _info(self, row: NDArray[np.float32]) -> dict[str, object]:
        strokes = row[self._strokes].astype(float)
        tip = self._geometry.tip(strokes)
        return {"truth": dict(zip((*STROKES, *TIP), (*strokes.tolist(), *tip.tolist()), strict=True))}


def _check_step(description: FmuDescription, rate_hz: float, where: str) -> None:
    """Raise an error for a rate that differs from the FMU's step.

    Raises:
        ConfigError: it does not.
    """
    own = description.step_s
    if own is None or description.any_step:
        return
    ratio = 1.0 / (rate_hz * own)
    # In 3.0 it is the step inside, of which a communication step may take several.
    whole = max(1, round(ratio)) if description.version == 3 else 1
    if abs(ratio - whole) > STEP_SLACK * whole:
        raise ConfigError(
            f"{where} takes steps of {typed(own)} s ({typed(1.0 / own)} Hz), the loops have {typed(rate_hz)} Hz; "
            f"set rate_hz = {setting_text(1.0 / own)}"
        )
