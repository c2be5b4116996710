"""Compiled equations of one form of grey box, and the positions of their inputs and derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.equations import Equations, GreyForm, Stage
from edp.networks.twin.grey.jit import compiler
from edp.networks.twin.symbolic.expression import Expression, ExpressionGraph
from edp.networks.twin.symbolic.machine_code import CodeModule, Loaded, digest_of, load, read_or_compile

IntArray = NDArray[np.int64]
ANGLES = 4
"""Number of values per joint: the angle and its first three derivatives with respect to the stroke."""


class FramePlaces(NamedTuple):
    """Position of the first value of each kind in the input array of the compiled functions.

    Attributes:
        unknowns: pressures and velocities.
        base: contents and velocities at the start of a stage.
        bristle_base: bristle deflections at the start of a stage.
        displacements: pump displacements.
        frozen: strokes in the middle of a step.
        speeds: velocities at the start of a step.
        reached: strokes at the end of a stage, without the contribution of the unknown velocities.
        strokes: strokes at the start of a step.
        bristles: bristle deflections.
        tangents: number of values listed so far. Each of these values has a row of tangents.
        valves: valve states.
        delayed_commands: valve commands one dead time ago.
        lag_factors: decay factors of the pilot lag and the spool lag of each valve, see `Equations.lag_factors`.
        mass: inertia matrix.
        forces: forces of the load on the actuators.
        joints: joint angles and their derivatives.
        half: half of the time from the start of the step to the end of the stage, s.
        step: length of the stage, s.
        length: time step of valves and pumps, s.
        size: number of all values.
    """

    unknowns: int
    base: int
    bristle_base: int
    displacements: int
    frozen: int
    speeds: int
    reached: int
    strokes: int
    bristles: int
    tangents: int
    valves: int
    delayed_commands: int
    lag_factors: int
    mass: int
    forces: int
    joints: int
    half: int
    step: int
    length: int
    size: int


# Index of each function in `GreyProgram.addresses`, and its results:
NEWTON = 0  # a step of Newton's method towards the root of a stage, to be subtracted
RESIDUAL = 1  # residual of a stage
MATRIX = 2  # derivatives of the residual by the unknowns
LOAD = 3  # inertia and forces of the load
SLOPES = 4  # as MATRIX, then BY_FRAME, BY_SPOOL and BY_PARAMETER
CONTENTS = 5  # of the nodes, their derivatives by the pressures, CONTENT_PARAMETERS
BRISTLES = 6  # deflections, their derivatives by velocity and by deflection before, BRISTLE_PARAMETERS
VALVES = 7  # states of the valves, VALVE_STATES, VALVE_OWN
PUMPS = 8  # displacements, PUMP_FRAME, PUMP_PILOTS, PUMP_PARAMETERS
LAG_FACTORS = 9  # decay factors of the valve lags
FAST_VALVES = 10  # states of the valves, for known decay factors
FUNCTIONS = (
    "newton", "residual", "matrix", "load", "slopes", "contents", "bristles", "valves", "pumps", "lag_factors",
    "fast_valves",
)  # fmt: skip

# Index of each group of derivatives in `GreyProgram.groups`.
(
    BY_FRAME, BY_SPOOL, BY_PARAMETER, CONTENT_PARAMETERS, BRISTLE_PARAMETERS, VALVE_STATES, VALVE_OWN, PUMP_FRAME,
    PUMP_PILOTS, PUMP_PARAMETERS,
) = range(10)  # fmt: skip
GROUPS = 10


class FormSizes(NamedTuple):
    """Numbers of actuators, valves, pumps, unknown pressures and parameters."""

    actuators: int
    valves: int
    pumps: int
    nodes: int
    parameters: int


class GreyProgram(NamedTuple):
    """Compiled functions of one form, and the positions of their derivatives.

    Attributes:
        addresses: address of each function, shape (function,).
        groups: for each group of derivatives: position of its first value in the results, its first row in `entries`,
            and the row after its last one, shape (group, 3).
        entries: result and variable of each derivative, shape (derivative, 2).
        own: positions of the dead time, pilot lag, spool lag and play of each valve, shape (valve, OWN).
        frame: positions of the inputs.
        sizes: sizes of the form.
        results: maximum number of results of a function.
    """

    addresses: IntArray
    groups: IntArray
    entries: IntArray
    own: IntArray
    frame: FramePlaces
    sizes: FormSizes
    results: int


class ExpressionAlgebra:
    """Algebra of `Equations` on expressions."""

    def __init__(self, graph: ExpressionGraph) -> None:
        self.graph, self.less = graph, graph.less

    def __getattr__(self, name: str) -> Any:
        return lambda a: self.graph.function(name, a)

    def derivatives(self, results: Sequence[Any], variables: Sequence[Expression]) -> list[list[Expression]]:
        """Return the Jacobian as nested lists, one row per result."""
        slopes = self.graph.jacobian([self.graph.wrap(result) for result in results], variables)
        zero = self.graph.wrap(0.0)
        return [[slopes.get((i, k), zero) for k in range(len(variables))] for i in range(len(results))]


def frame_of(form: GreyForm) -> FramePlaces:
    """Return the positions of the inputs of a form."""
    n, pumps, valves, unknowns = form.actuators, form.pumps, form.valves, form.unknowns
    counts = [unknowns, unknowns, n, pumps, n, n, n, n, n]
    tangents = sum(counts)
    counts += [0, valves * at.VALVE_STATES, valves, 2 * valves, n * n, n, ANGLES * len(form.joint_actuators), 1, 1, 1]
    places = np.concatenate([[0], np.cumsum(counts)]).tolist()
    places[9] = tangents
    return FramePlaces(*places)


@cache
def program_of(form: GreyForm) -> GreyProgram:
    """Return the compiled functions of a form, from the cache on disk if it has them."""
    functions = _Functions(form)
    return functions.program(load_module(functions.module, form))


def load_module(module: CodeModule, identity: object) -> Loaded:
    """Load the functions of a module, from the cache on disk if it has them under this identity."""
    file = None if compiler.folder is None else compiler.folder / f"{digest_of(identity)}.o"
    loaded = load(read_or_compile(file, module.object_code), module.names)
    _LOADED.append(loaded)
    return loaded


_LOADED: list[Loaded] = []
"""Loaded code of this process: freed code would leave the addresses dangling."""


def _solution(matrix: Sequence[Sequence[Expression]], right: Sequence[Expression]) -> list[Expression]:
    """Solve linear equations by elimination without pivoting; pressures come first, where the diagonal dominates."""
    rows, values = [list(row) for row in matrix], list(right)
    size = len(values)
    inverses = []
    for k in range(size):
        inverses.append(1.0 / rows[k][k])
        for i in range(k + 1, size):
            factor = rows[i][k] * inverses[k]
            for j in range(k + 1, size):
                rows[i][j] = rows[i][j] - factor * rows[k][j]
            values[i] = values[i] - factor * values[k]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            values[i] = values[i] - rows[i][k] * values[k]
        values[i] = values[i] * inverses[i]
    return values


class _Functions:
    """Functions of a form as expressions."""

    def __init__(self, form: GreyForm) -> None:
        self.form, self.frame, self.graph = form, frame_of(form), ExpressionGraph()
        self.parameters = self.graph.inputs("parameter", form.parameters)
        constants = self.graph.inputs("constant", form.constants)
        self.inputs = self.graph.inputs("input", self.frame.size)
        self.equations = Equations(form, self.parameters, constants, ExpressionAlgebra(self.graph))
        self.module = CodeModule(self.graph, (self.parameters, constants, self.inputs))
        self.groups, self.entries = np.zeros((GROUPS, 3), np.int64), np.zeros((0, 2), np.int64)
        self.results = 0
        self._stage()
        self._contents()
        self._bristles()
        self._valves()
        self._pumps()

    def _part(self, first: int, count: int) -> list[Expression]:
        return self.inputs[first : first + count]

    def _add(self, name: str, results: Sequence[Any]) -> None:
        self.results = max(self.results, len(results))
        self.module.add(name, [self.graph.wrap(result) for result in results])

    def _slopes(
        self, group: int, first: int, results: Sequence[Any], variables: dict[int, Expression]
    ) -> list[Expression]:
        """Return the derivatives by `variables` (by column) and record their positions in the results."""
        columns = list(variables)
        slopes = self.graph.jacobian([self.graph.wrap(result) for result in results], list(variables.values()))
        self._note(group, first, [(row, columns[k]) for row, k in slopes])
        return list(slopes.values())

    def _note(self, group: int, first: int, places: Sequence[tuple[int, int]]) -> None:
        begin = len(self.entries)
        self.entries = np.concatenate([self.entries, np.array(places, np.int64).reshape(-1, 2)])
        self.groups[group] = first, begin, len(self.entries)

    def _index_parameters(self) -> dict[int, Expression]:
        return dict(enumerate(self.parameters))

    def _stage(self) -> None:
        form, frame, n = self.form, self.frame, self.form.actuators
        unknowns, strokes = self._part(frame.unknowns, form.unknowns), self._part(frame.frozen, n)
        states = self._part(frame.valves, form.valves * at.VALVE_STATES)
        spools = states[at.SPOOL :: at.VALVE_STATES]
        joints = []
        for a, actuator in enumerate(form.joint_actuators):
            angle = self._part(frame.joints + ANGLES * a, ANGLES)
            self.graph.link(angle, strokes[actuator])
            joints.append(angle[0])
        stage = Stage(
            base=self._part(frame.base, form.unknowns),
            bristles=self._part(frame.bristle_base, n),
            spools=spools,
            displacements=self._part(frame.displacements, form.pumps),
            strokes=strokes,
            reached=self._part(frame.reached, n),
            half=self.inputs[frame.half],
            step=self.inputs[frame.step],
        )
        flat, forces = self._part(frame.mass, n * n), self._part(frame.forces, n)
        residual = self.equations.stage(unknowns, stage, [flat[n * i : n * i + n] for i in range(n)], forces)
        matrix = self._jacobian(residual, unknowns)
        self._add("newton", _solution(matrix, residual))
        self._add("residual", residual)
        self._add("matrix", [slope for row in matrix for slope in row])
        mass, load_forces = self.equations.load(strokes, self._part(frame.speeds, n), joints)
        self._add("load", [*(value for row in mass for value in row), *load_forces])
        # Include the load: its forces depend on strokes, velocities and parameters.
        whole = self.equations.stage(unknowns, stage, mass, load_forces)
        written: list[Expression] = [slope for row in self._jacobian(whole, unknowns) for slope in row]
        moving = {k: self.inputs[k] for k in range(frame.base, frame.strokes)}
        for group, variables in (
            (BY_FRAME, moving),
            (BY_SPOOL, dict(enumerate(spools))),
            (BY_PARAMETER, self._index_parameters()),
        ):
            written += self._slopes(group, len(written), whole, variables)
        self._add("slopes", written)

    def _jacobian(self, results: Sequence[Any], variables: Sequence[Expression]) -> list[list[Expression]]:
        return self.equations.algebra.derivatives(results, variables)

    def _contents(self) -> None:
        pressures = self._part(self.frame.unknowns, self.form.nodes)
        contents = self.equations.contents(pressures)
        own = [self._jacobian([content], [p])[0][0] for content, p in zip(contents, pressures, strict=True)]
        written = [*contents, *own]
        written += self._slopes(CONTENT_PARAMETERS, len(written), contents, self._index_parameters())
        self._add("contents", written)

    def _bristles(self) -> None:
        form, frame, n = self.form, self.frame, self.form.actuators
        speeds = self._part(frame.unknowns + form.nodes, n)
        before, step = self._part(frame.bristle_base, n), self.inputs[frame.step]
        after = [self.equations.friction(i, speeds[i], before[i], step)[0] for i in range(n)]
        by_speed = [self._jacobian([after[i]], [speeds[i]])[0][0] for i in range(n)]
        by_before = [self._jacobian([after[i]], [before[i]])[0][0] for i in range(n)]
        written = [*after, *by_speed, *by_before]
        written += self._slopes(BRISTLE_PARAMETERS, len(written), after, self._index_parameters())
        self._add("bristles", written)

    def _valves(self) -> None:
        form, frame = self.form, self.frame
        states = self._part(frame.valves, form.valves * at.VALVE_STATES)
        commands, length = self._part(frame.delayed_commands, form.valves), self.inputs[frame.length]
        lag_factors = [self.equations.lag_factors(j, length) for j in range(form.valves)]
        computed = self._part(frame.lag_factors, 2 * form.valves)
        after: list[Expression] = []
        followed: list[Expression] = []
        for j in range(form.valves):
            own = states[at.VALVE_STATES * j : at.VALVE_STATES * (j + 1)]
            after += self.equations.advance_valve(own, commands[j], lag_factors[j])
            followed += self.equations.advance_valve(own, commands[j], computed[2 * j : 2 * j + 2])
        self._add("lag_factors", [part for parts in lag_factors for part in parts])
        self._add("fast_valves", followed)
        written = [*after]
        written += self._slopes(VALVE_STATES, len(written), after, dict(enumerate([*states, *commands])))
        places, slopes = [], []
        for j, positions in enumerate(self.own):
            mine = after[at.VALVE_STATES * j : at.VALVE_STATES * (j + 1)]
            for (row, column), slope in self.graph.jacobian(mine, [self.parameters[k] for k in positions]).items():
                places.append((at.VALVE_STATES * j + row, column))
                slopes.append(slope)
        self._note(VALVE_OWN, len(written), places)
        self._add("valves", [*written, *slopes])

    @property
    def own(self) -> list[list[int]]:
        """Positions of the parameters of each valve's command path."""
        play = self.form.circuit_at + at.PLAY
        return [[row[at.DELAY], row[at.PILOT_LAG], row[at.SPOOL_LAG], play] for row in self.form.valve_at]

    def _pumps(self) -> None:
        form, frame = self.form, self.frame
        states = self._part(frame.valves, form.valves * at.VALVE_STATES)
        pilots, lines = states[at.PILOT_2 :: at.VALVE_STATES], frame.unknowns + 2 * form.actuators
        before = self._part(frame.displacements, form.pumps)
        after = self.equations.displacements(before, pilots, self._part(lines, form.pumps), self.inputs[frame.length])
        written = [*after]
        places = [*range(frame.displacements, frame.displacements + form.pumps), *range(lines, lines + form.pumps)]
        for group, variables in (
            (PUMP_FRAME, {k: self.inputs[k] for k in places}),
            (PUMP_PILOTS, dict(enumerate(pilots))),
            (PUMP_PARAMETERS, self._index_parameters()),
        ):
            written += self._slopes(group, len(written), after, variables)
        self._add("pumps", written)

    def program(self, loaded: Loaded) -> GreyProgram:
        """Return the program for loaded machine code."""
        form = self.form
        sizes = FormSizes(form.actuators, form.valves, form.pumps, form.nodes, form.parameters)
        own, addresses = np.array(self.own, np.int64), [loaded.addresses[name] for name in FUNCTIONS]
        results = np.array(addresses, np.int64), self.groups, self.entries, own
        return GreyProgram(*results, frame=self.frame, sizes=sizes, results=self.results)
