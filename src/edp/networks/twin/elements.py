"""Tanks, masses and lags as differential equations of few numbers, for small systems that are no excavator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.ir import Builder
from edp.networks.twin.base import PREFIX, TWINS, Twin, TwinState
from edp.networks.twin.lumped.lowering import lowered_answers
from edp.networks.twin.lumped.parts import (
    EDGE,
    MOST_ELEMENTS,
    SLIP,
    SPILL,
    Doubles,
    LagElement,
    LumpedNumber,
    MassElement,
    Parts,
    TankElement,
    check_parts,
    default_parts,
    lumped_numbers,
)
from edp.networks.twin.scales import Array, TwinScales
from edp.settings.bounds import MOST_UPDATES, check_bounds, check_count, integer, span

Values = NDArray[Any]
"""Real, or complex where the imaginary part carries a derivative (a complex step is exact to rounding)."""
PRIOR = 0.2
"""Plausible deviation of a level that is not measured, as a share of the tank's height."""


@TWINS.register("elements")
@dataclass(frozen=True, kw_only=True)
class ElementsBox:
    """Elements of a small physical system; without any, a mass for each velocity and a lag for each pressure.

    Attributes:
        tanks: in the order of the flow.
        masses: with their drives.
        lags: pressures that follow commands.
        steps: of the solver in a tick.
        prefix_ticks: measured ticks before a free run.
        starts: from how many starting values the fit begins.
        rounds: Gauss-Newton steps of each start at most.
        length_s: of the free runs that are fitted; 0: whole recordings, in runs of at most 4,096 ticks.

    Raises:
        ConfigError: a value out of range.
    """

    tanks: tuple[TankElement, ...] = ()
    masses: tuple[MassElement, ...] = ()
    lags: tuple[LagElement, ...] = ()
    steps: int = 2
    prefix_ticks: int = 10
    starts: int = 4
    rounds: int = 40
    length_s: float = 0.0

    def __post_init__(self) -> None:
        counts = {"steps": integer(1, 64), "starts": integer(1, 100), "rounds": integer(1, MOST_UPDATES)}
        check_bounds("elements", self, prefix_ticks=PREFIX, length_s=span(0.0, 600.0), **counts)
        for name in ("tanks", "masses", "lags"):
            check_count("elements", name, getattr(self, name), MOST_ELEMENTS)

    def parts(self, channels: TwinChannels) -> Parts:
        """Connected elements.

        Raises:
            ConfigError: a port that is not connected, or a channel that no element has.
        """
        named = Parts(self.tanks, self.masses, self.lags)
        parts = named if self.tanks or self.masses or self.lags else default_parts(channels)
        check_parts(parts, channels)
        return parts

    def start(self, channels: TwinChannels, scales: TwinScales, train: Sequence[Series], seed: int) -> ElementsTwin:
        """With plausible numbers."""
        numbers = [n.nominal for n in lumped_numbers(self.parts(channels), channels, scales)]
        return self.build(channels, scales, {"numbers": np.array(numbers, np.float32)})

    def shapes(self, channels: TwinChannels) -> dict[str, tuple[int, ...]]:
        """All numbers."""
        parts = self.parts(channels)
        return {"numbers": (5 * len(parts.tanks) + 5 * len(parts.masses) + 3 * len(parts.lags),)}

    def build(self, channels: TwinChannels, scales: TwinScales, arrays: Mapping[str, Array]) -> ElementsTwin:
        """The elements with these numbers."""
        twin = ElementsTwin(channels, scales, self, arrays["numbers"].astype(np.float64))
        if not (twin.numbers[[n.positive for n in twin.table]] > 0).all():
            raise ValueError("one of its numbers is not positive")
        return twin


def ramp(values: Values, width: float | Values) -> Values:
    """A smooth maximum of zero and the values, rounded over the width."""
    share = values / width
    up = share.real > 0
    return np.asarray(width * (np.log1p(np.exp(np.where(up, -share, share))) + np.where(up, share, 0.0)))


class ElementsTwin(Twin):
    """State: ``answer`` in SI units, and ``hidden`` levels of the tanks that are not measured ``(batch, tank)``."""

    def __init__(self, channels: TwinChannels, scales: TwinScales, spec: ElementsBox, numbers: Doubles) -> None:
        super().__init__(channels, scales, spec.prefix_ticks)
        self.spec, self.elements, self.numbers = spec, spec.parts(channels), numbers
        self.table: list[LumpedNumber] = lumped_numbers(self.elements, channels, scales)
        names = [c.name for c in channels.answers]
        self.columns = {name: i for i, name in enumerate(names)}
        self.inputs = {c.name: i for i, c in enumerate(channels.commands)}
        self.hidden = [tank.name for tank in self.elements.tanks if not tank.level]
        self.places = {(n.element, n.name): i for i, n in enumerate(self.table)}

    def with_numbers(self, numbers: Doubles) -> ElementsTwin:
        """The same elements with other numbers, rounded as they are kept."""
        rounded = numbers.astype(np.float32).astype(np.float64)
        return ElementsTwin(self.channels, self.scales, self.spec, rounded)

    def starting_levels(self, numbers: Values) -> Values:
        """Of the tanks that are not measured ``(..., tank)``."""
        return np.stack([numbers[..., self.places[name, "start"]] for name in self.hidden], axis=-1)

    def initial_state(self, command: Array, measured: Array) -> TwinState:
        hidden = np.zeros((len(measured), len(self.hidden)), np.float32)
        if self.hidden:
            hidden[:] = self.starting_levels(self.numbers)
        return {"answer": measured.astype(np.float32), "hidden": hidden}

    def reset(self, commands: Array, measured: Array) -> TwinState:
        """State after a measured stretch; levels that are not measured are those that explain it best."""
        state = super().reset(commands, measured)
        if not self.hidden:
            return state
        first = np.asarray(measured, np.float64)[:, 0]
        finite = np.isfinite(np.asarray(measured)[:, 1:])
        truth = np.where(finite, np.asarray(measured, np.float64)[:, 1:], 0.0)
        begin = np.tile(self.starting_levels(self.numbers), (len(first), 1))
        levels, count = begin.copy(), len(self.hidden)
        for _ in range(4):
            errors: list[Doubles] = []
            slopes: list[Doubles] = []
            for j in range(count):
                tried = levels + 1e-20j * np.eye(count)[j]
                answers = self.free_run(self.numbers, np.asarray(commands, np.float64)[:, :-1], first + 0j, tried)
                scaled = np.where(finite, (answers - truth) / self.scales.change_width, 0.0).reshape(len(first), -1)
                errors, slopes = [scaled.real], [*slopes, scaled.imag / 1e-20]
            slope = np.stack(slopes, axis=-1)
            matrix = slope.swapaxes(1, 2) @ slope + np.eye(count) / PRIOR**2
            pull = (slope.swapaxes(1, 2) @ errors[0][..., None])[..., 0] + (levels - begin) / PRIOR**2
            levels = np.maximum(levels - np.linalg.solve(matrix, pull[..., None])[..., 0], 0.0)
        start = {"answer": first.astype(np.float32), "hidden": levels.astype(np.float32)}
        return self.rollout(np.asarray(commands, np.float32), start, np.asarray(measured, np.float32))[1]

    def free_run(self, numbers: Values, commands: Doubles, answer: Values, hidden: Values) -> Values:
        """Answers ``(batch, tick, answer)`` by numbers ``(number,)`` or ``(batch, number)``; complex: with slopes."""
        answers = []
        for t in range(commands.shape[1]):
            answer, hidden = self.tick(numbers, commands[:, t], answer, hidden)
            answers.append(answer)
        return np.stack(answers, axis=1)

    def tick(self, numbers: Values, command: Doubles, answer: Values, hidden: Values) -> tuple[Values, Values]:
        """One tick from what the ports read and the levels that are not measured."""
        after = np.array(answer)
        rows = numbers if numbers.ndim == 2 else numbers[None]
        self._move_masses(rows, command, answer, after)
        for lag in self.elements.lags:
            gain, offset, lag_s = (rows[:, self.places[lag.name, n]] for n in ("gain", "offset", "lag"))
            goal = gain * command[:, self.inputs[lag.command]] + offset
            share = 1.0 - np.exp(-1.0 / (lag_s * self.channels.rate_hz))
            column = self.columns[lag.pressure]
            after[:, column] = self._held(answer[:, column] + share * (goal - answer[:, column]), column)
        return after, self._fill_tanks(rows, command, answer, after, hidden)

    def _held(self, values: Values, column: int) -> Values:
        """Within the bounds of an answer; a slope passes where no bound acts."""
        low, high = float(self.scales.low[column]), float(self.scales.high[column])
        return np.where(values.real < low, low, np.where(values.real > high, high, values))

    def _move_masses(self, rows: Values, command: Doubles, answer: Values, after: Values) -> None:
        """Velocities by a half-implicit step; strokes by the trapezoidal rule, held at the end stops."""
        step, count = 1.0 / (self.channels.rate_hz * self.spec.steps), len(self.channels.velocities)
        for mass in self.elements.masses:
            names = ("gain", "viscous", "viscous_asymmetry", "coulomb", "offset")
            gain, viscous, skew, coulomb, offset = (rows[:, self.places[mass.name, n]] for n in names)
            column = self.columns[mass.velocity]
            slip = SLIP * float(self.scales.high[column])
            push = gain * command[:, self.inputs[mass.command]] - offset
            velocity = answer[:, column]
            for _ in range(self.spec.steps):
                side = np.tanh(velocity / slip)
                damping = viscous * (1.0 + skew * side)
                steep = damping + (coulomb + viscous * skew * velocity) * (1.0 - side * side) / slip
                velocity = velocity + step * (push - damping * velocity - coulomb * side) / (1.0 + step * steep)
            velocity = self._held(velocity, column)
            if self.channels.strokes:
                stroke_at = count + column
                low, high = float(self.scales.low[stroke_at]), float(self.scales.high[stroke_at])
                stroke = answer[:, stroke_at] + 0.5 * (answer[:, column] + velocity) / self.channels.rate_hz
                into = ((stroke.real > high) & (velocity.real > 0)) | ((stroke.real < low) & (velocity.real < 0))
                velocity = np.where(into, 0.0, velocity)
                after[:, stroke_at] = self._held(stroke, stroke_at)
            after[:, column] = velocity

    def _fill_tanks(self, rows: Values, command: Doubles, answer: Values, after: Values, hidden: Values) -> Values:
        """Levels by the midpoint rule; the velocity of a measured one is its mean over the tick."""
        tanks, rate = self.elements.tanks, self.channels.rate_hz
        if not tanks:
            return hidden
        step, unseen = 1.0 / (rate * self.spec.steps), iter(range(len(self.hidden)))
        now = [answer[:, self.columns[tank.level]] if tank.level else hidden[:, next(unseen)] for tank in tanks]
        for _ in range(self.spec.steps):
            half = [a + 0.5 * step * b for a, b in zip(now, self._flows(rows, command, now), strict=True)]
            now = [a + step * b for a, b in zip(now, self._flows(rows, command, half), strict=True)]
        left = []
        for tank, level in zip(tanks, now, strict=True):
            if tank.level:
                stroke_at = self.columns[tank.level]
                after[:, stroke_at] = self._held(level, stroke_at)
                speed = stroke_at - len(self.channels.velocities)
                after[:, speed] = self._held((after[:, stroke_at] - answer[:, stroke_at]) * rate, speed)
            else:
                left.append(np.where(level.real < 0, 0.0, level))
        return np.stack(left, axis=1) if left else hidden

    def _flows(self, rows: Values, command: Doubles, levels: Sequence[Values]) -> list[Values]:
        """Rates of the levels, m/s."""
        leaving: dict[str, tuple[Values, Values]] = {}
        rates = []
        for tank, level in zip(self.elements.tanks, levels, strict=True):
            inflow, outflow, exponent = (rows[:, self.places[tank.name, n]] for n in ("inflow", "outflow", "exponent"))
            edge = rows[:, self.places[tank.name, "edge"]] if tank.level else 1.0
            if tank.source in self.inputs:
                which = self.inputs[tank.source]
                width = EDGE * float(self.scales.command_width[which])
                filled = inflow * ramp(command[:, which] - rows[:, self.places[tank.name, "inflow_offset"]], width)
            else:
                out, over = leaving[tank.source]
                filled = inflow * (out + rows[:, self.places[tank.name, "spilled_into"]] * over)
            share = level / edge
            out = ramp(share, EDGE) ** exponent
            over = SPILL * self.channels.rate_hz * ramp(share - 1.0, EDGE)
            leaving[tank.name] = out, over / outflow
            rates.append(edge * (filled - outflow * out - over))
        return rates

    def _run(self, commands: Array, measured: Array, state: TwinState) -> tuple[Array, TwinState]:
        answer, hidden = state["answer"], state["hidden"]
        answers = np.empty(measured.shape, np.float32)
        for t in range(commands.shape[1]):
            read = np.where(np.isnan(measured[:, t]), answer, measured[:, t]).astype(np.float64)
            after, levels = self.tick(self.numbers, commands[:, t].astype(np.float64), read, hidden.astype(np.float64))
            # Rounded at each tick, so that a run that goes on from a kept state is the same one.
            answer, hidden = after.astype(np.float32), levels.astype(np.float32)
            answers[:, t] = answer
        return answers, {"answer": answer.copy(), "hidden": hidden.copy()}

    def lower_answers(self, build: Builder, commands: str, fed: str) -> str:
        return lowered_answers(build, self, fed)

    def arrays(self) -> dict[str, Array]:
        return self.scales.arrays() | {"numbers": self.numbers.astype(np.float32)}
