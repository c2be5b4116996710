"""Tanks, masses and lags as layers: products, quotients and functions, a few for each step of the solver."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edp.ir import Builder
from edp.ir.base import INPUT
from edp.ir.layers import Activate, BinaryOperation, Clip, Function, ScaleShift
from edp.ir.memory import Feed, Feedback
from edp.networks.twin.lowering import add_stroke_stops
from edp.networks.twin.lumped.constants import EDGE, EMPTY, SLIP, SPILL
from edp.networks.twin.lumped.parts import Doubles

if TYPE_CHECKING:
    from edp.networks.twin.elements import ElementsTwin

ADD, SUBTRACT, MULTIPLY, DIVIDE = (
    BinaryOperation.ADD,
    BinaryOperation.SUBTRACT,
    BinaryOperation.MULTIPLY,
    BinaryOperation.DIVIDE,
)

Values = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class _Tick:
    """Context for the layers of one sample: the graph under construction, the twin, and the port readings."""

    build: Builder
    twin: ElementsTwin
    fed: str

    def numbers(self, elements: list[str], name: str, default: float | None = None) -> Doubles:
        """Return one parameter of each element; `default` for elements without this parameter."""
        places = [self.twin.places.get((element, name), -1) for element in elements]
        if default is None:
            return self.twin.numbers[places]
        return np.array([default if index < 0 else self.twin.numbers[index] for index in places])

    def drives(self, name: str, channels: list[str]) -> str:
        """Add the commands of these channels in SI units."""
        return self.build.pick(name, INPUT, [self.twin.inputs[channel] for channel in channels])

    def line(self, name: str, x: str, gain: float | Values, shift: float | Values = 0.0) -> str:
        """Return ``gain x + shift``."""
        one = np.ones(self.build.width(x))
        return self.build.add(ScaleShift, name, x, gain=gain * one, shift=shift * one)

    def apply(self, function: Function, name: str, x: str) -> str:
        """Apply a function to each element."""
        return self.build.add(Activate, name, x, function=function, size=self.build.width(x))

    def both(self, name: str, operation: BinaryOperation, a: str, b: str) -> str:
        """Apply an operation to two values."""
        return self.build.combine(name, operation, a, b)

    def read(self, name: str, columns: list[int]) -> str:
        """Add the port readings in SI units."""
        scales = self.twin.scales
        fed = self.build.pick(name, self.fed, columns)
        return self.line(f"{name}_si", fed, scales.answer_width[columns], scales.answer_offset[columns])

    def scaled(self, name: str, x: str, columns: list[int]) -> str:
        """Scale SI values of outputs."""
        width, offset = self.twin.scales.answer_width[columns], self.twin.scales.answer_offset[columns]
        return self.line(name, x, 1.0 / width, -offset / width)

    def bounded(self, name: str, x: str, columns: list[int]) -> str:
        """Limit scaled outputs to their bounds."""
        scales = self.twin.scales
        offset, width = scales.answer_offset[columns], scales.answer_width[columns]
        low, high = ((end[columns] - offset) / width for end in (scales.low, scales.high))
        return self.build.add(Clip, name, x, low=low, high=high)


def lowered_answers(build: Builder, twin: ElementsTwin, fed: str) -> str:
    """Add the scaled, bounded outputs from SI commands and scaled port readings; see `lumped.run`.

    Levels that are not measured are a second feedback edge, which starts where a reset of the twin does.
    """
    tick, parts, channels = _Tick(build, twin, fed), twin.elements, twin.channels
    answers: dict[int, tuple[str, int]] = {}

    def note(value: str, columns: list[int]) -> None:
        answers.update({column: (value, i) for i, column in enumerate(columns)})

    if parts.masses:
        with build.inside("masses"):
            columns = [twin.columns[mass.velocity] for mass in parts.masses]
            speed = tick.bounded("bounded", tick.scaled("scaled", _masses(tick), columns), columns)
            if channels.strokes:
                speed, stroke = add_stroke_stops(build, twin, fed, speed, columns)
                note(stroke, [len(channels.velocities) + column for column in columns])
            note(speed, columns)
    if parts.lags:
        with build.inside("lags"):
            columns = [twin.columns[lag.pressure] for lag in parts.lags]
            note(tick.bounded("bounded", _lags(tick, columns), columns), columns)
    if parts.tanks:
        with build.inside("tanks"):
            for value, columns in _tanks(tick):
                note(value, columns)
    values = list(dict.fromkeys(value for value, _ in answers.values()))
    first = dict(zip(values, np.cumsum([0, *map(build.width, values)]), strict=False))
    joined = build.join("of_elements", *values)
    return build.pick("together", joined, [int(first[answers[c][0]]) + answers[c][1] for c in sorted(answers)])


def _masses(tick: _Tick) -> str:
    """Return the velocities after the half-implicit steps of a tick, SI units."""
    twin, masses = tick.twin, tick.twin.elements.masses
    names, columns = [mass.name for mass in masses], [twin.columns[mass.velocity] for mass in masses]
    gain, viscous, skew, coulomb, offset = (
        tick.numbers(names, n) for n in ("gain", "viscous", "viscous_asymmetry", "coulomb", "offset")
    )
    slip, step = SLIP * twin.scales.high[columns].astype(np.float64), 1.0 / (twin.channels.rate_hz * twin.spec.steps)
    push = tick.line("push", tick.drives("drives", [mass.command for mass in masses]), gain, -offset)
    velocity = tick.read("velocity", columns)
    for k in range(twin.spec.steps):
        with tick.build.inside(f"step_{k + 1}"):
            side = tick.apply(Function.TANH, "side", tick.line("slip", velocity, 1.0 / slip))
            damping = tick.line("damping", side, viscous * skew, viscous)
            flat = tick.line("flat", tick.both("square", MULTIPLY, side, side), -1.0 / slip, 1.0 / slip)
            lean = tick.both("lean", MULTIPLY, tick.line("rise", velocity, viscous * skew, coulomb), flat)
            under = tick.line("under", tick.both("steep", ADD, damping, lean), step, 1.0)
            drag = tick.both("drag", MULTIPLY, damping, velocity)
            drag = tick.both("friction", ADD, drag, tick.line("coulomb", side, coulomb))
            change = tick.line("change", tick.both("net", SUBTRACT, push, drag), step)
            velocity = tick.both("moved", ADD, velocity, tick.both("implicit", DIVIDE, change, under))
    return velocity


def _lags(tick: _Tick, columns: list[int]) -> str:
    """Return the pressures after a tick, scaled."""
    twin, lags = tick.twin, tick.twin.elements.lags
    gain, offset, lag_s = (tick.numbers([lag.name for lag in lags], n) for n in ("gain", "offset", "lag"))
    width, zero = (values[columns] for values in (twin.scales.answer_width, twin.scales.answer_offset))
    share = 1.0 - np.exp(-1.0 / (lag_s * twin.channels.rate_hz))
    drives = tick.drives("drives", [lag.command for lag in lags])
    pulled = tick.line("goal", drives, share * gain / width, share * (offset - zero) / width)
    remaining = tick.line("kept", tick.build.pick("before", tick.fed, columns), 1.0 - share)
    return tick.both("lagged", ADD, remaining, pulled)


def _tanks(tick: _Tick) -> list[tuple[str, list[int]]]:
    """Return the velocities and levels of the tanks that are measured, scaled, with their columns."""
    twin, build, tanks = tick.twin, tick.build, tick.twin.elements.tanks
    measured = [tank for tank in tanks if tank.level]
    columns = [twin.columns[tank.level] for tank in measured]
    order = [tank.name for tank in (*measured, *(tank for tank in tanks if not tank.level))]
    values = [tick.read("level", columns)] if measured else []
    hidden = build.add(Feedback, "hidden", size=len(twin.hidden)) if twin.hidden else ""
    if hidden:
        slots = [(hidden, slot) for slot in build.layers[-1].slots]
        build.start_from(slots, twin.starting_levels(twin.numbers))
        values.append(hidden)
    before = build.pick("in_order", build.join("levels", *values), [order.index(tank.name) for tank in tanks])
    risen = _add_level_changes(tick, before)
    if hidden:
        own = [i for i, tank in enumerate(tanks) if not tank.level]
        left = tick.both("left", ADD, build.pick("before", before, own), build.pick("rise", risen, own))
        build.add(Feed, "remembered", tick.apply(Function.RELU, "no_less_than_empty", left), into=hidden)
    if not measured:
        return []
    own, count = [i for i, tank in enumerate(tanks) if tank.level], len(twin.channels.velocities)
    scales, rate = twin.scales, twin.channels.rate_hz
    # The way of a level, and not the level, is bounded: a velocity as a difference of levels would have few digits.
    level, way = build.pick("measured", before, own), build.pick("way", risen, own)
    for end, operation in ((scales.high, BinaryOperation.MINIMUM), (scales.low, BinaryOperation.MAXIMUM)):
        way = tick.both("held", operation, way, tick.line("room", level, -1.0, end[columns].astype(np.float64)))
    share = tick.line("share", way, 1.0 / scales.answer_width[columns].astype(np.float64))
    stroke = tick.both("after", ADD, build.pick("fed", tick.fed, columns), share)
    speeds = [column - count for column in columns]
    speed = tick.scaled("speed", tick.line("per_tick", way, rate), speeds)
    return [(tick.bounded("stroke", stroke, columns), columns), (tick.bounded("bounded", speed, speeds), speeds)]


def _add_level_changes(tick: _Tick, before: str) -> str:
    """Add the changes of all levels in a sample, by the midpoint rule."""
    twin, build, tanks = tick.twin, tick.build, tick.twin.elements.tanks
    step, inflow = 1.0 / (twin.channels.rate_hz * twin.spec.steps), tick.numbers([t.name for t in tanks], "inflow")
    pumped = np.array([tank.source in twin.inputs for tank in tanks])
    zero = tick.numbers([tank.name for tank in tanks], "inflow_offset", 0.0)
    # A tank that no pump fills reads any command, times zero.
    which = [twin.inputs[tank.source] if p else 0 for tank, p in zip(tanks, pumped, strict=True)]
    width = EDGE * twin.scales.command_width[which].astype(np.float64)
    lifted = tick.line("above_offset", build.pick("pumps", INPUT, which), 1.0 / width, -zero / width)
    filled = tick.line("pumped", tick.apply(Function.SOFTPLUS, "ramp", lifted), np.where(pumped, inflow * width, 0.0))
    risen = ""
    for k in range(twin.spec.steps):
        with build.inside(f"step_{k + 1}"):
            now = tick.both("now", ADD, before, risen) if risen else before
            half = tick.line("half", _rates(tick, now, filled), 0.5 * step)
            whole = tick.line("whole", _rates(tick, tick.both("middle", ADD, now, half), filled), step)
            risen = tick.both("risen", ADD, risen, whole) if risen else whole
    return risen


def _rates(tick: _Tick, levels: str, pumped: str) -> str:
    """Return the rates of the levels, m/s."""
    twin, build, tanks = tick.twin, tick.build, tick.twin.elements.tanks
    names, rate = [tank.name for tank in tanks], twin.channels.rate_hz
    inflow, outflow, exponent = (tick.numbers(names, n) for n in ("inflow", "outflow", "exponent"))
    edge, zero = tick.numbers(names, "edge", 1.0), tick.numbers(names, "zero", 0.0)
    gain, shift = 1.0 / (edge * EDGE), -zero / (edge * EDGE)
    full = tick.apply(Function.SOFTPLUS, "full", tick.line("share", levels, gain, shift))
    bound = np.full(len(tanks), EMPTY)
    share = build.add(Clip, "not_empty", tick.line("height", full, EDGE), low=bound, high=1.0 / bound)
    logarithm = tick.apply(Function.LOG, "logarithm", share)
    out = tick.apply(Function.EXP, "out", tick.line("exponent", logarithm, exponent))
    beyond = tick.line("beyond", levels, gain, shift - 1.0 / EDGE)
    over = tick.line("over", tick.apply(Function.SOFTPLUS, "spill", beyond), SPILL * rate * EDGE)
    above = [names.index(tank.source) if tank.source in names else i for i, tank in enumerate(tanks)]
    fed = np.array([tank.source not in twin.inputs for tank in tanks])
    into = tick.numbers(names, "spilled_into", 0.0)
    through = tick.line("through", build.pick("out_above", out, above), np.where(fed, inflow, 0.0))
    spilled = tick.line("spilled", build.pick("over_above", over, above), inflow * into / outflow[above])
    coming = tick.both("coming", ADD, tick.both("flows", ADD, pumped, through), spilled)
    going = tick.both("going", ADD, tick.line("leaving", out, outflow), over)
    return tick.line("rate", tick.both("balance", SUBTRACT, coming, going), edge)
