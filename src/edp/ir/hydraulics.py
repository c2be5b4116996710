"""The layer of a grey box: one tick of pumps, valves, cylinders, motors and their load as differential equations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from edp.ir.base import Array, Indices, Layer, LayerRun, Memory, Slot, Values

NONE = 2**16 - 1
"""Entry for a missing element in a table of positions."""
VALVE_STATES = 5


@dataclass(frozen=True, eq=False, kw_only=True)
class HydraulicTick(Layer):
    """Velocities and pressures after one sample, scaled like the outputs, from commands in SI units and port values.

    The equations are those of `edp.networks.twin.grey`, in double precision; the state is stored in single precision.
    Internal units are m, s, MPa, MN and Gg. Positions are indices of `numbers`, `NONE` for a missing element.

    Attributes:
        numbers: parameters of the machine.
        full: the largest command of each valve.
        knots: knots of all opening curves.
        middle: centre of each stroke; `scale` maps a stroke to -1..1, 0 for a stroke that is not measured.
        scale: scale of each stroke, see `middle`.
        offset: offset of each output, in internal units; `answer_width` is its width.
        answer_width: width of each output, in internal units.
        linkage: linkage of three cylinders in the order of `edp.networks.twin.grey.parameter_index`; a single zero if
            the load consists of polynomials.
        sides: commands that extend and retract ``(valve, 2)``.
        valve_at: positions of each valve's parameters ``(valve, 13)``.
        valve_actuator: actuator of each valve.
        valve_pump: pump of each valve; `NONE` for a supply at constant pressure.
        actuator_at: positions of each actuator's parameters.
        pump_at: positions of each pump's parameters; a single `NONE` without pumps.
        ports: kind of each port (velocity 0, stroke 1, pressure 2) and its index ``(output, 2)``.
        exponents: exponents of the load's monomials ``(term, actuator)``.
        load: places of the first coefficient of the inertia's root (of the first body of a linkage) and of the
            potential, and coefficients of each entry of the root between them.
        circuit: position of the circuit's parameters.
        remembered: number of stored demand samples.
        steps: number of implicit steps per sample.
        tick_s: sample time, s.
    """

    tick_by_tick = True
    without: ClassVar[Mapping[str, str]] = {
        "integers": "its equations need double precision: export in float32",
        "tangent": "export it to casadi, whose equations have derivatives",
        "onnx": "export it to c, fmu, casadi, simulink or ros2",
        "matlab": "export it to c, fmu, casadi, simulink or ros2",
    }

    numbers: Array
    full: Array
    knots: Array
    middle: Array
    scale: Array
    offset: Array
    answer_width: Array
    linkage: Array
    sides: Indices
    valve_at: Indices
    valve_actuator: Indices
    valve_pump: Indices
    actuator_at: Indices
    pump_at: Indices
    ports: Indices
    exponents: Indices
    load: tuple[int, int, int]
    circuit: int
    remembered: int
    steps: int
    tick_s: float

    @property
    def width(self) -> int:
        return int((self.ports[:, 0] != 1).sum())

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Actuators, valves and pumps."""
        return len(self.actuator_at), len(self.full), int((self.pump_at != NONE).sum())

    @property
    def unknown(self) -> int:
        """Number of pressures and velocities solved for in an implicit stage."""
        actuators, _, pumps = self.sizes
        return 3 * actuators + pumps

    @property
    def linked(self) -> bool:
        """Whether bodies of a linkage are the load."""
        return len(self.linkage) > 1

    @property
    def powers(self) -> int:
        """Powers of a stroke in the load: its degree and one."""
        return int(self.exponents.max(initial=0)) + 1

    @property
    def slots(self) -> tuple[Slot, ...]:
        actuators, valves, pumps = self.sizes
        return (
            Slot("pressures_and_velocities", (self.unknown,)),
            Slot("strokes", (actuators,)),
            Slot("bristles", (actuators,)),
            # C has no empty arrays.
            Slot("displacements", (max(pumps, 1),)),
            Slot("valves", (valves, VALVE_STATES)),
            Slot("history", (self.remembered, valves)),
        )

    @property
    def macs(self) -> int:
        """Multiply-accumulates of the linear equations with one iteration per stage, the minimum of a sample."""
        size = self.unknown
        elimination, substitution = (size - 1) * size * (2 * size - 1) // 6, size * (size - 1)
        return 2 * self.steps * (elimination + substitution)

    @property
    def room(self) -> int:
        """Number of double-precision work elements per sample, as divided in the C code."""
        n, valves, pumps = self.sizes
        nodes, terms = self.unknown + 2 - n, len(self.exponents)
        network = 4 * self.unknown + self.unknown**2 + 2 * nodes + nodes**2
        load = 12 * n + 4 * n**2 + n**3 + terms * (1 + n) + 2 * n * self.powers
        return network + load + valves * (1 + VALVE_STATES) + 2 * pumps

    def over_time(self, run: LayerRun, commands: Values, fed: Values) -> Values:
        if not SOLVERS:
            raise NotImplementedError("the equations of a grey box are solved by edp.networks.twin.grey: import it")
        if commands.shape[1] != 1:
            raise ValueError(f"layer '{self.name}' computes one stream at a time, not {commands.shape[1]}")
        (solve,) = SOLVERS
        memory = {slot: values[0] for slot, values in run.memory.items()}
        answers = solve(self, run.constants, memory, commands[0, 0], fed[0, 0])
        run.memory.update({slot: values[None] for slot, values in memory.items()})
        return np.asarray(answers[None, None])


SOLVERS: list[Callable[[HydraulicTick, Mapping[str, Values], Memory, Values, Values], Values]] = []
"""Solvers of one time step by name, called with layer, constants, memory, commands and ports. The module of the
equations registers its solver here."""
