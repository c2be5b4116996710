"""Tanks, masses and lags as differential equations with few parameters, for small systems other than excavators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.ir import Builder
from edp.networks.twin.base import PREFIX, TWINS, Twin, TwinState
from edp.networks.twin.lumped.lowering import lowered_answers
from edp.networks.twin.lumped.parts import (
    MAX_ELEMENTS,
    Doubles,
    LagElement,
    MassElement,
    Parts,
    TankElement,
    check_parts,
    default_parts,
    lumped_parameters,
)
from edp.networks.twin.lumped.run import Values, Wiring, free_run, simulate_measured
from edp.networks.twin.scales import Array, TwinScales
from edp.settings.bounds import MAX_UPDATES, check_bounds, check_count, integer, span

PRIOR = 0.2
"""Prior standard deviation of an unmeasured tank level, as a fraction of the tank height."""


@TWINS.register("elements")
@dataclass(frozen=True, kw_only=True)
class ElementsBox:
    """Elements of a small physical system; without any, a mass for each velocity and a lag for each pressure.

    Attributes:
        tanks: tanks in the order of the flow.
        masses: masses with their drives.
        lags: pressures that follow commands.
        steps: number of solver steps per sample.
        prefix_ticks: measured ticks before a free run.
        starts: number of starting points of the fit.
        rounds: Gauss-Newton steps of each start at most.
        length_s: length of the fitted free runs, s; 0 for whole recordings, in runs of at most 4,096 samples.

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
        counts = {"steps": integer(1, 64), "starts": integer(1, 100), "rounds": integer(1, MAX_UPDATES)}
        check_bounds("elements", self, prefix_ticks=PREFIX, length_s=span(0.0, 600.0), **counts)
        for name in ("tanks", "masses", "lags"):
            check_count("elements", name, getattr(self, name), MAX_ELEMENTS)

    def parts(self, channels: TwinChannels) -> Parts:
        """Return the connected elements.

        Raises:
            ConfigError: a port that is not connected, or a channel that no element has.
        """
        named = Parts(self.tanks, self.masses, self.lags)
        parts = named if self.tanks or self.masses or self.lags else default_parts(channels)
        check_parts(parts, channels)
        return parts

    def start(self, channels: TwinChannels, scales: TwinScales, train: Sequence[Series], seed: int) -> ElementsTwin:
        """Return a twin with typical parameters."""
        numbers = [n.nominal for n in lumped_parameters(self.parts(channels), channels, scales)]
        return self.build(channels, scales, {"numbers": np.array(numbers, np.float32)})

    def shapes(self, channels: TwinChannels) -> dict[str, tuple[int, ...]]:
        """Return the shape of the parameter vector."""
        parts = self.parts(channels)
        tanks = sum(6 if tank.level else 5 for tank in parts.tanks)
        return {"numbers": (tanks + 5 * len(parts.masses) + 3 * len(parts.lags),)}

    def build(self, channels: TwinChannels, scales: TwinScales, arrays: Mapping[str, Array]) -> ElementsTwin:
        """Build the elements with these parameters."""
        twin = ElementsTwin(channels, scales, self, arrays["numbers"].astype(np.float64))
        if not (twin.numbers[[n.positive for n in twin.table]] > 0).all():
            raise ValueError("one of its numbers is not positive")
        return twin


class ElementsTwin(Twin):
    """State: ``answer`` (outputs) in SI units, and ``hidden`` levels of the unmeasured tanks ``(batch, tank)``."""

    def __init__(self, channels: TwinChannels, scales: TwinScales, spec: ElementsBox, numbers: Doubles) -> None:
        super().__init__(channels, scales, spec.prefix_ticks)
        self.spec, self.elements, self.numbers = spec, spec.parts(channels), numbers
        self.table = lumped_parameters(self.elements, channels, scales)
        names = [c.name for c in channels.answers]
        self.columns = {name: i for i, name in enumerate(names)}
        self.inputs = {c.name: i for i, c in enumerate(channels.commands)}
        self.hidden = [tank.name for tank in self.elements.tanks if not tank.level]
        self.places = {(n.element, n.name): i for i, n in enumerate(self.table)}
        self.wiring = self._wiring()

    def with_parameters(self, numbers: Doubles) -> ElementsTwin:
        """Return the elements with other parameters, rounded to the stored precision."""
        rounded = numbers.astype(np.float32).astype(np.float64)
        return ElementsTwin(self.channels, self.scales, self.spec, rounded)

    def starting_levels(self, numbers: Values) -> Values:
        """Return the initial levels of the unmeasured tanks ``(..., tank)``."""
        return np.stack([numbers[..., self.places[name, "start"]] for name in self.hidden], axis=-1)

    def initial_state(self, command: Array, measured: Array) -> TwinState:
        hidden = np.zeros((len(measured), len(self.hidden)), np.float32)
        if self.hidden:
            hidden[:] = self.starting_levels(self.numbers)
        return {"answer": measured.astype(np.float32), "hidden": hidden}

    def reset(self, commands: Array, measured: Array) -> TwinState:
        """Return the state after a measured segment; unmeasured levels are those that explain it best."""
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
        """Simulate outputs ``(batch, tick, output)`` for parameters ``(number,)`` or ``(batch, number)``.

        Complex ones give derivatives.
        """
        kind = np.result_type(numbers, answer, hidden, np.float64)
        lanes = np.broadcast_to(numbers, (len(answer), len(self.table)))
        values = (np.ascontiguousarray(part, dtype=kind) for part in (lanes, answer, hidden))
        own, first, levels = values
        return np.asarray(free_run(own, np.ascontiguousarray(commands, np.float64), first, levels, self.wiring))

    def _wiring(self) -> Wiring:
        """Return the connections of the elements for compiled code."""
        parts, channels, scales = self.elements, self.channels, self.scales
        names, unseen = [tank.name for tank in parts.tanks], iter(range(len(self.hidden)))
        lags = [(self.inputs[lag.command], self.columns[lag.pressure], self._first(lag.name)) for lag in parts.lags]
        masses = [(self.inputs[m.command], self.columns[m.velocity], self._first(m.name)) for m in parts.masses]
        tanks = []
        for tank in parts.tanks:
            pump = self.inputs.get(tank.source, -1)
            above = -1 if pump >= 0 else names.index(tank.source)
            level = (self.columns[tank.level], -1) if tank.level else (-1, next(unseen))
            tanks.append((pump, above, *level, self._first(tank.name)))
        rows = (np.array(some, np.int64).reshape(-1, wide) for some, wide in ((lags, 3), (masses, 3), (tanks, 5)))
        low, high, widths = (part.astype(np.float64) for part in (scales.low, scales.high, scales.command_width))
        facts = (self.spec.steps, len(channels.velocities), bool(channels.strokes))
        first, second, third = rows
        return first, second, third, low, high, widths, facts, float(channels.rate_hz)

    def _first(self, element: str) -> int:
        """Place of the first number of an element."""
        return min(index for (owner, _), index in self.places.items() if owner == element)

    def _run(self, commands: Array, measured: Array, state: TwinState) -> tuple[Array, TwinState]:
        answer, hidden = (np.array(state[name], np.float32, order="C") for name in ("answer", "hidden"))
        driven, read = (np.ascontiguousarray(part, np.float32) for part in (commands, measured))
        answers = np.asarray(simulate_measured(self.numbers, driven, read, answer, hidden, self.wiring))
        return answers, {"answer": answer, "hidden": hidden}

    def lower_answers(self, build: Builder, commands: str, fed: str) -> str:
        return lowered_answers(build, self, fed)

    def arrays(self) -> dict[str, Array]:
        return self.scales.arrays() | {"numbers": self.numbers.astype(np.float32)}
