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
from edp.control.geometry import AXES
from edp.control.model_batch import ModelBatch, ModelEnvironment
from edp.control.plant import STROKES
from edp.errors import ConfigError
from edp.sim.environment.batch import Bools
from edp.sim.scenario import SimulationError
from edp.wording import setting_text, typed

Array = NDArray[np.float64]
Rows = NDArray[np.float32]
REST_S = 2.0
"""Duration of the steady state before the prefix, s. The memory of a twin settles during this time."""
START_SHARE = 0.02
"""Maximum difference between the requested and the actual initial stroke of an FMU, as a fraction of the stroke."""
STEP_SLACK = 1e-6


class FmuBatch(ModelBatch):
    """Plants that are instances of one FMU; arguments and errors as in `FmuEnvironment`."""

    noun, source = "an FMU", "the FMU"

    def __init__(self, path: str | Path, machine: str, duration_s: float, rate_hz: float, count: int = 1) -> None:
        archive = FmuArchive(path)
        self._where = f"FMU '{archive.path}'"
        description = read_description(archive.description(), self._where)
        self._ports = ports_of(description, self._where)
        _check_step(description, rate_hz, self._where)
        answers, commands = self._ports.answers, self._ports.commands
        prefix = description.window or round(rate_hz)
        super().__init__(answers, commands, machine, rate_hz, prefix, duration_s, count)
        self._fmus = [FmuInstance(archive, description) for _ in range(count)]
        self._elapsed = [0] * count

    def close(self) -> None:
        """Unload the FMUs; afterwards they cannot run."""
        for fmu in self._fmus:
            fmu.close()

    def _start(self, index: int, shares: Any) -> Rows:
        self._elapsed[index] = 0
        return self._feed(index, shares) if self._ports.measured[0] else self._set_start(index, shares)

    def _answer(self, pilots: Rows, active: Bools | None) -> Array:
        answers = self.observed[:, : len(self._ports.answers)].astype(float)
        for index, fmu in enumerate(self._fmus):
            if active is None or active[index]:
                fmu.put(self._ports.inputs, pilots[index].tolist())
                self._go(index)
                answers[index] = self._read(index)
        return answers

    def _feed(self, index: int, shares: Any) -> Rows:
        """Begin with measured values: a steady phase, then the prefix that initialises a twin's memory."""
        rows, fmu = self._rest_rows(shares), self._fmus[index]
        values, flags = self._ports.measured
        fmu.begin()
        fmu.put(flags, [1.0] * len(flags))
        before = np.repeat(rows[:1], round(REST_S * self.rate_hz), axis=0)
        for row in np.concatenate([before, rows[:-1]]).tolist():
            fmu.put((*values, *self._ports.inputs), row)
            self._go(index)
        fmu.put(flags, [0.0] * len(flags))
        return np.asarray(rows[-1])

    def _set_start(self, index: int, shares: Any) -> Rows:
        """Begin by parameters, or where the FMU begins."""
        asked_m, fmu = np.array([float(share) for share in shares]) * self._geometry.full_m, self._fmus[index]
        fmu.begin(self._ports.starts, asked_m.tolist() if self._ports.starts else ())
        neutral = self._pilots(np.zeros(AXES))
        fmu.put(self._ports.inputs, neutral.tolist())
        row = np.concatenate([self._read(index), neutral]).astype(np.float32)
        apart = np.abs(row[self._strokes] - asked_m) / self._geometry.full_m
        if apart.max() > START_SHARE:
            axis = int(np.argmax(apart))
            raise ConfigError(
                f"{self._where} begins with {STROKES[axis]} at {row[self._strokes][axis]:.3f} m, the task at "
                f"{asked_m[axis]:.3f} m, and it has no parameters CylStroke_1_start to 3 that it heeds; give it such "
                "parameters, or start tasks where it begins"
            )
        return row

    def _go(self, index: int) -> None:
        self._fmus[index].step(self._elapsed[index] / self.rate_hz, 1.0 / self.rate_hz)
        self._elapsed[index] += 1

    def _read(self, index: int) -> Array:
        answers = np.array(self._fmus[index].read(self._ports.outputs))
        if not np.isfinite(answers).all():
            name = self.channels[int(np.argmin(np.isfinite(answers)))].name
            ticks = self.tick[index]
            raise SimulationError(f"{self._where} answers '{name}' = {answers.min()} after {ticks} ticks")
        return answers


class FmuEnvironment(ModelEnvironment):
    """An environment whose machine is an FMU for co-simulation, of version 2.0 or 3.0.

    Levers become nominal pilot pressures; the observation holds the outputs of the FMU and these. It begins at the
    strokes of the task in one of three ways: by measured values (``CylVels_1`` and ``CylVels_1_measured``, as exported
    twins have them), by parameters ``CylStroke_1_start``, or where it begins by itself, if that is there.
    The option of a reset is ``strokes``, shares of full to start from.

    Its library is native code that runs in this process with the rights of its user.

    Args:
        path: the file.
        machine: name or file of the machine whose kinematics, nominal commands and pressures in steady state are used.
        duration_s: length of an episode.
        rate_hz: sampling rate in Hz.

    Raises:
        ConfigError: FMPy is not installed, there is no such file, or it is no excavator, or of another rate.
        DataError: it is damaged, hostile, or without a library for this computer.
    """

    _batch: FmuBatch

    def __init__(self, path: str | Path, machine: str, duration_s: float, rate_hz: float) -> None:
        super().__init__(FmuBatch(path, machine, duration_s, rate_hz))

    def close(self) -> None:
        """Unload the FMU; afterwards it cannot run."""
        self._batch.close()
        self._idle = "has not begun"


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
