"""A trained twin as a plant, with the interface of the simulator's environment: one argument exchanges them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.control.model_batch import ModelBatch, ModelEnvironment, check_plant_channels
from edp.networks.twin import Twin, TwinState
from edp.networks.twin.grey.ground import GroundedRunner, GroundLaw
from edp.sim.environment.batch import Bools

Rows = NDArray[np.float32]


class TwinBatch(ModelBatch):
    """Plants that are one batch of a twin; arguments and errors as in `TwinEnvironment`.

    A ground acts on one plant only.
    """

    noun, source = "a twin", "the twin"

    def __init__(
        self, twin: Twin, machine: str, duration_s: float, count: int = 1, ground: GroundLaw | None = None
    ) -> None:
        channels, self.twin = twin.channels, twin
        answers, commands = ([channel.name for channel in part] for part in (channels.answers, channels.commands))
        check_plant_channels("the twin", commands, answers, "train it on such recordings")
        prefix = twin.prefix_ticks
        super().__init__(channels.answers, channels.commands, machine, channels.rate_hz, prefix, duration_s, count)
        self._state: TwinState = {}
        self._grounded = None if ground is None else GroundedRunner(twin, ground)
        self._digs, self._free = False, np.full(len(answers), np.nan, np.float32)

    def _choose_soil(self, material: Any) -> None:
        if self._grounded is None:
            super()._choose_soil(material)
        else:
            self._digs = bool(material)
            self._grounded.begin()

    def _start(self, index: int, shares: Any) -> Rows:
        """Begin with a prefix in steady state, in which the memory of the twin forms."""
        rows, answers = self._rest_rows(shares), len(self.twin.channels.answers)
        state = self.twin.reset(rows[None, :-1, answers:], rows[None, :-1, :answers])
        if self.count == 1 or not self._state:
            self._state = {name: np.repeat(values, self.count, axis=0) for name, values in state.items()}
        else:
            self._state = {name: values.copy() for name, values in self._state.items()}
            for name, values in state.items():
                self._state[name][index] = values[0]
        last: Rows = rows[-1]
        return last

    def _answer(self, pilots: Rows, active: Bools | None) -> Rows:
        if self._grounded is not None and self._digs:
            self._state = self._grounded.step(pilots[0], self._state, self._free)
            return self._state["answer"]
        answers, self._state = self.twin.step(pilots, self._state)
        return answers


class TwinEnvironment(ModelEnvironment):
    """An environment whose machine is a twin on commands alone.

    Levers become nominal pilot pressures, one tick of the twin outputs them, and the observation holds its velocities,
    strokes and pressures and the pilot pressures, without noise. ``info["truth"]`` holds strokes and tip. Its memory
    forms in a prefix in steady state, which the simulator's machine of the same name shows at the strokes of the start.

    Options of a reset are ``strokes``, shares of full to start from, and ``material``: of a twin with a ground, any
    name lets it act, uncut. A twin draws nothing.

    Args:
        twin: twin of an excavator with the channels of Table A.1 and strokes.
        machine: name or file of the machine whose kinematics, nominal commands and pressures in steady state are used.
        duration_s: length of an episode.
        ground: law of the ground that acts where a reset names a material; it stands for any.

    Raises:
        ConfigError: the twin has no strokes, channels that no excavator has, or cannot stand on a ground.
    """

    def __init__(self, twin: Twin, machine: str, duration_s: float = 60.0, ground: GroundLaw | None = None) -> None:
        super().__init__(TwinBatch(twin, machine, duration_s, ground=ground))
        self.twin = twin
