"""A grey box: pumps, valves, cylinders, motors and their load as differential equations, fitted to free runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError, closest
from edp.ir import Builder
from edp.networks.twin.base import PREFIX, TWINS, Twin, TwinRunner, TwinState
from edp.networks.twin.descent import NormalEquations
from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.channel_map import GreyChannelMap, turning_scales
from edp.networks.twin.grey.correction import Cell, OutputBounds, RunTrace
from edp.networks.twin.grey.elements import (
    CylinderElement,
    Elements,
    MotorElement,
    PumpElement,
    ValveElement,
    default_elements,
)
from edp.networks.twin.grey.equations import GreyForm
from edp.networks.twin.grey.fit_spec import GreyFitSpec
from edp.networks.twin.grey.initial_guess import load_start
from edp.networks.twin.grey.known_linkage import KnownLinkage, check_linkage
from edp.networks.twin.grey.lowering import add_layer
from edp.networks.twin.grey.parameters import LEFT_OUT, ParameterTable, finer_values, number_table
from edp.networks.twin.grey.priors import STRETCHES, Travel
from edp.networks.twin.grey.program import GreyProgram, program_of
from edp.networks.twin.grey.rollouts import FitTarget, RunBatch, evaluate_run, run_batch
from edp.networks.twin.grey.runner import GreyRunner
from edp.networks.twin.grey.tick import MachineArrays, machine_arrays
from edp.networks.twin.grey.validation import check_elements
from edp.networks.twin.scales import FASTEST, HIGHEST, Array, TwinScales
from edp.settings.bounds import MAX_NAMES, check_bounds, check_count, integer

Doubles = NDArray[np.float64]
POLYNOMIALS = (2, 4)
"""Default degrees of the polynomials of inertia and gravity."""
LONGEST_DELAY_S = 0.3
"""Maximum dead time of a command that a fit can find, s."""
LONGEST_STEP_S = 0.0125
"""Maximum length of an implicit step, s. Longer steps would damp load oscillations of several Hz."""
ROWS = 2048
"""Maximum number of rows of the Jacobian in memory during a fit."""
REST_MPA = 2.0
"""Initial pressure of a chamber without a sensor, MPa."""


@TWINS.register("greybox")
@dataclass(frozen=True, kw_only=True)
class GreyBox:
    """Elements of a hydraulic machine; by default they are derived from names and kinds of the channels.

    Attributes:
        cylinders: cylinders and their channels.
        motors: motors and their channels.
        valves: spools between pumps and cylinders or motors.
        pumps: pumps and their pressure channels. Without pumps, valves are supplied at constant pressure.
        inertia_degree: degree of the stroke polynomials in the triangular factor of the inertia matrix.
        potential_degree: degree of the polynomial of the strokes that is the potential energy.
        linkage: machine name or machine file. Rigid bodies of this linkage, moved by the cylinders boom, arm and
            bucket, replace the polynomials. Empty for polynomials.
        omit: parts of the equations to omit: `power_limit` of the pumps, `cushions` at the end stops, `play` of the
            spools.
        curve_segments: number of segments of a spool's opening curve: 5, 10 or 20. 0 selects the number by free-run
            simulation on the validation part. A bundle without this entry has 5.
        prefix_ticks: number of measured samples before a free-run simulation.
        fit: settings of the fit.

    Raises:
        ConfigError: a value is out of range, `omit` has an unknown entry, or degrees are set together with a
            linkage.
    """

    cylinders: tuple[CylinderElement, ...] = ()
    motors: tuple[MotorElement, ...] = ()
    valves: tuple[ValveElement, ...] = ()
    pumps: tuple[PumpElement, ...] = ()
    inertia_degree: int = POLYNOMIALS[0]
    potential_degree: int = POLYNOMIALS[1]
    linkage: str = ""
    omit: tuple[str, ...] = ()
    curve_segments: int = 0
    prefix_ticks: int = 30
    fit: GreyFitSpec = field(default_factory=GreyFitSpec)

    def __post_init__(self) -> None:
        degree = integer(0, 4)
        check_bounds("grey box", self, inertia_degree=degree, potential_degree=integer(1, 6), prefix_ticks=PREFIX)
        for name in ("cylinders", "motors", "valves", "pumps"):
            check_count("grey box", name, getattr(self, name), MAX_NAMES)
        check_count("grey box", "omit", self.omit, len(LEFT_OUT))
        if self.linkage and self.degrees != POLYNOMIALS:
            raise ConfigError(
                f"grey box: inertia_degree = {self.inertia_degree} and potential_degree = {self.potential_degree} are "
                f"of polynomials, which twin.linkage = '{self.linkage[:80]}' replaces; leave the degrees out, or the "
                "linkage"
            )
        if self.curve_segments not in (0, *STRETCHES):
            raise ConfigError(
                f"grey box: curve_segments = {self.curve_segments}; any of {', '.join(map(str, STRETCHES))}, or 0 for "
                "the validation part to choose, must hold"
            )
        for part in self.omit:
            if part not in LEFT_OUT:
                raise ConfigError(
                    f"grey box: omit names '{part}'{closest(part, tuple(LEFT_OUT))}; any of {', '.join(LEFT_OUT)} "
                    "must hold"
                )

    def elements(self, channels: TwinChannels) -> Elements:
        """Return the connected elements.

        Raises:
            ConfigError: a port is not connected, or a pressure channel belongs to no element.
        """
        if self.cylinders or self.motors or self.valves or self.pumps:
            elements = Elements(self.pumps, self.cylinders, self.valves, self.motors)
        else:
            elements = default_elements(channels)
        check_elements(elements, channels)
        if self.linkage:
            check_linkage(self.linkage[:80], elements, channels)
        return elements

    def start(self, channels: TwinChannels, scales: TwinScales, train: Sequence[Series], seed: int) -> GreyTwin:
        """Return a twin with typical parameters. Fit the load to the measured forces if all states are measured."""
        elements = self.elements(channels)
        front = KnownLinkage.read(self.linkage, elements, channels, scales) if self.linkage else None
        table = self.table(elements, channels, scales, front)
        commands = np.concatenate([series.inputs for series in train])
        full = [_full(commands[:, _sides(valve, channels)]) for valve in elements.valves]
        arrays = {"numbers": table.nominal.astype(np.float32), "full": np.array(full, np.float32)}
        arrays |= {} if front is None else front.arrays()
        twin = self.build(channels, scales, arrays | self._network(channels, seed))
        # Both sides of a motor have the same displacement: only the first one is fitted.
        declared = [isinstance(one, MotorElement) or one.areas is not None for one in elements.actuators]
        values = load_start(table, train, twin.wiring.columns, twin.wiring.z_of, channels.rate_hz, declared)
        return twin.with_parameters(values)

    def shapes(self, channels: TwinChannels) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the parameters and of the full-scale commands of the valves."""
        elements = self.elements(channels)
        travels = [Travel(0.0, 1.0, 1.0, (1.0, 1.0))] * len(elements.actuators)
        own = KnownLinkage.SHAPES if self.linkage else {}
        front = KnownLinkage(*(np.ones(shape) for shape in own.values())) if own else None
        pumps = [1.0] * len(elements.pumps)
        table = number_table(elements, travels, pumps, self.degrees, self.omit, front, self.curve)
        return {"numbers": (len(table.numbers),), "full": (len(elements.valves),), **own}

    def build(self, channels: TwinChannels, scales: TwinScales, arrays: Mapping[str, Array]) -> GreyTwin:
        """Build the grey box with the given parameters. Does not read the machine file of a linkage again."""
        elements = self.elements(channels)
        table = self.table(elements, channels, scales, KnownLinkage.from_arrays(arrays) if self.linkage else None)
        numbers = arrays["numbers"].astype(np.float64)
        if not (numbers[table.positive] > 0).all():
            raise ValueError("one of its numbers is not positive")
        if not (numbers == numbers[table.priors.leader]).all():
            raise ValueError("both sides of one of its motors have not the same displacement")
        scales = turning_scales(elements, channels, scales)
        wiring = GreyChannelMap.connect(elements, channels, scales)
        return GreyTwin(channels, scales, self, (table, wiring), numbers, arrays["full"])

    def _network(self, channels: TwinChannels, seed: int) -> dict[str, Array]:
        """Return the untrained arrays of an additional network: an empty dictionary for a grey box without one."""
        return {}

    @property
    def degrees(self) -> tuple[int, int]:
        """Degrees of the polynomials of inertia and gravity."""
        return self.inertia_degree, self.potential_degree

    @property
    def curve(self) -> int:
        """Number of segments of an opening curve: the smallest one until a number is selected, and in old bundles."""
        return self.curve_segments or STRETCHES[0]

    def table(
        self, elements: Elements, channels: TwinChannels, scales: TwinScales, front: KnownLinkage | None
    ) -> ParameterTable:
        """Return the parameter table with initial values from the scales of the data."""
        names = [channel.name for channel in channels.answers]
        count = len(channels.velocities)

        def highest(name: str) -> float:
            return float(scales.high[names.index(name)]) / HIGHEST / 1e6 if name else 30.0

        travels = []
        for actuator in elements.actuators:
            i = names.index(actuator.velocity)
            low, high = (scales.low[count + i], scales.high[count + i]) if channels.strokes else (-0.5, 0.5)
            fastest, (first, second) = float(scales.high[i]) / FASTEST, actuator.chambers
            travels.append(Travel(float(low), float(high), fastest, (highest(first), highest(second))))
        pumps = [highest(pump.pressure) * HIGHEST for pump in elements.pumps]
        return number_table(elements, travels, pumps, self.degrees, self.omit, front, self.curve)


def _sides(valve: ValveElement, channels: TwinChannels) -> list[int]:
    names = [channel.name for channel in channels.commands]
    return [names.index(name) for name in (valve.extend, valve.retract) if name]


def _full(commands: Array) -> float:
    """Return the largest absolute command, or 1 if all commands are zero."""
    return float(np.abs(commands).max()) or 1.0


@dataclass(frozen=True, eq=False)
class RunTarget:
    """Measured outputs and the loss of free-run simulations, in units of the grey box.

    Attributes:
        truth: measured outputs after the command of each sample, shape (run, tick, output).
        weight: weight of the error of each output, shape (output,).
        delta: weighted error above which the Huber loss is linear.
        prefix: number of samples at the start whose errors are omitted.
        followed: number of samples of the prefix in which all states are measured, so that the load is not evaluated.
        stride: the loss uses every `stride`-th sample.
    """

    truth: Doubles
    weight: Doubles
    delta: float
    prefix: int
    followed: int = 0
    stride: int = 1


class GreyTwin(Twin):
    """Twin of a grey box.

    Its state has the outputs (``answer``, SI units) and the entries `STATES`, which have the units of
    `edp.networks.twin.grey.parameter_index`.
    """

    def __init__(
        self,
        channels: TwinChannels,
        scales: TwinScales,
        spec: GreyBox,
        parts: tuple[ParameterTable, GreyChannelMap],
        numbers: Doubles,
        full: Array,
    ) -> None:
        super().__init__(channels, scales, spec.prefix_ticks)
        self.spec, (self.table, self.wiring) = spec, parts
        self.numbers, self.full = numbers, full

    def with_parameters(self, numbers: Doubles) -> GreyTwin:
        """Return a twin with the given parameters, rounded to single precision as in a bundle."""
        rounded = numbers.astype(np.float32).astype(np.float64)
        return GreyTwin(self.channels, self.scales, self.spec, (self.table, self.wiring), rounded, self.full)

    def with_stretches(self, stretches: int) -> GreyTwin:
        """Return a twin with the same outputs whose opening curves have more segments."""
        spec = replace(self.spec, curve_segments=stretches)
        if spec.curve % self.table.stretches:
            raise ValueError(f"curve_segments = {stretches}; a multiple of {self.table.stretches} must hold")
        elements = spec.elements(self.channels)
        table = spec.table(elements, self.channels, self.scales, self.table.front)
        parts = (table, self.wiring)
        return GreyTwin(
            self.channels, self.scales, spec, parts, finer_values(self.table, self.numbers, table), self.full
        )

    @property
    def units(self) -> Doubles:
        """Unit of each output of the equations in SI units: 1e6 Pa for pressures, else 1."""
        return np.where(self.wiring.ports[:, 0] == 2, 1e6, 1.0)

    @property
    def program(self) -> GreyProgram:
        """Compiled equations."""
        table, wiring = self.table, self.wiring
        arrays = vars(table) | {"valve_actuator": wiring.actuator, "valve_pump": wiring.pump, "knots": table.knots}
        load = table.inertia_at, table.inertia_terms, table.potential_at
        return program_of(GreyForm.from_arrays(arrays, table.linkage, table.circuit_at, load))

    def machine(self, numbers: Doubles) -> MachineArrays:
        """Return the arrays of the machine for the given parameters."""
        middle, scale = self.wiring.z_of
        return machine_arrays(numbers, (middle, scale), self.table.linkage, self.wiring.ports, self.time)

    @property
    def time(self) -> tuple[float, int]:
        """Length of a sample in seconds, and number of implicit steps per sample."""
        tick = 1.0 / self.channels.rate_hz
        return tick, max(1, int(np.ceil(tick / LONGEST_STEP_S - 1e-9)))

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Numbers of unknowns (pressures and velocities), strokes, bristles and pumps."""
        actuators = len(self.wiring.columns)
        return self.wiring.nodes + actuators, actuators, actuators, len(self.table.pump_at)

    def demands(self, commands: Array) -> Doubles:
        """Return the valve commands as fractions of full scale, shape (batch, tick, valve). Extension is positive."""
        extend, retract = self.wiring.sides.T
        signed = commands[..., extend].astype(np.float64)
        signed -= np.where(retract >= 0, commands[..., retract], 0.0)
        return np.ascontiguousarray(np.clip(signed / self.full, -1.0, 1.0))

    def rest(self, demands: Doubles, measured: Array) -> tuple[Doubles, ...]:
        """Return steady states in the order of `STATES`.

        Args:
            demands: valve commands, shape (batch, valve).
            measured: outputs in SI units, shape (batch, output).
        """
        wiring, batch, n = self.wiring, len(demands), len(self.wiring.columns)
        y, strokes = np.zeros((batch, wiring.nodes + n)), np.tile(wiring.z_of[0], (batch, 1))
        y[:, : wiring.nodes] = REST_MPA
        for column, (kind, which) in enumerate(wiring.ports):
            values = measured[:, column] / self.units[column]
            if kind == 1:
                strokes[:, which] = values
            else:
                y[:, which + (wiring.nodes if kind == 0 else 0)] = values
        longest = round(LONGEST_DELAY_S * self.channels.rate_hz) + 2
        least = [self.numbers[index + at.LEAST] for index in self.table.pump_at]
        return (
            y,
            strokes,
            np.zeros((batch, n)),
            np.tile(np.array(least), (batch, 1)),
            np.repeat(demands[:, :, None], at.VALVE_STATES, axis=2),
            np.repeat(demands[:, None], longest, axis=1),
        )

    def initial_state(self, command: Array, measured: Array) -> TwinState:
        rest = self.rest(self.demands(command[:, None])[:, 0], measured)
        named = {name: values.astype(np.float32) for name, values in zip(STATES, rest, strict=True)}
        return {"answer": measured.astype(np.float32)} | named

    def _run(self, commands: Array, measured: Array, state: TwinState) -> tuple[Array, TwinState]:
        return self.answered(commands, measured, state)

    def answered(
        self,
        commands: Array,
        measured: Array,
        state: TwinState,
        cell: Cell | None = None,
        trace: RunTrace | None = None,
    ) -> tuple[Array, TwinState]:
        """Simulate as `rollout` does, without checks, and with a correction cell if one is passed."""
        now = [np.array(state[name], np.float64, order="C") for name in ("answer", *STATES)]
        now[0] /= self.units
        answers = np.empty(measured.shape)
        batch = RunBatch(self.demands(commands), measured / self.units, *now)
        bounds = OutputBounds(self.scales.low / self.units, self.scales.high / self.units, self.units)
        run_batch(self.program, self.machine(self.numbers), bounds, batch, answers, cell, trace)
        after = {name: values.astype(np.float32) for name, values in zip(STATES, now[1:], strict=True)}
        rounded = answers.astype(np.float32)
        return rounded, {"answer": rounded[:, -1].copy()} | after

    def evaluate_runs(self, numbers: Doubles, batch: RunBatch, target: RunTarget, full: bool) -> NormalEquations:
        """Return the losses of free-run simulations, with gradient and Gauss-Newton matrix if `full`.

        Args:
            numbers: parameters, shape (parameter,).
            batch: runs at their start. The states are changed in place.
            target: measured outputs and loss.
            full: whether to compute gradient and matrix.
        """
        runs, ticks, _ = batch.demands.shape
        size = len(numbers) if full else 0
        rows = ((ticks - target.prefix) // target.stride + 2) * len(self.wiring.ports) if full else 0
        matrix, gradient, losses = np.zeros((size, size)), np.zeros(size), np.zeros(runs)
        program, machine = self.program, self.machine(numbers)
        # One product of many rows takes less time than one product per run.
        together = max(1, ROWS // max(rows, 1))
        for first in range(0, runs, together):
            last = min(first + together, runs)
            slopes, errors = np.zeros(((last - first) * rows, size)), np.zeros((last - first) * rows)
            for run in range(first, last):
                own = slice((run - first) * rows, (run - first + 1) * rows)
                part = FitTarget(
                    target.truth, target.weight, target.delta, target.prefix, target.followed, target.stride,
                    errors[own], slopes[own],
                )  # fmt: skip
                losses[run] = evaluate_run(program, machine, batch, run, part)
                if not np.isfinite(losses[run]):
                    slopes[own], errors[own] = 0.0, 0.0
            if full:
                matrix += slopes.T @ slopes
                gradient += slopes.T @ errors
        return NormalEquations(matrix, gradient, losses)

    def runner(self) -> TwinRunner:
        return GreyRunner(self, STATES)

    def lower(self, build: Builder, commands: str, fed: str) -> str:
        return add_layer(build, self, fed)

    def arrays(self) -> dict[str, Array]:
        front = {} if self.table.front is None else self.table.front.arrays()
        return self.scales.arrays() | {"numbers": self.numbers.astype(np.float32), "full": self.full} | front


STATES = ("pressures_and_velocities", "strokes", "bristles", "displacements", "valves", "history")
