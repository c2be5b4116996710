"""Parameters of an exported controller: a PI loop and, for a planning controller, its plan, in SI units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.signals import Channel
from edp.training.bundle import Bundle

Array = NDArray[np.float64]
AXES = 3
Side = tuple[Array, Array]


@dataclass(frozen=True)
class PilotCommand:
    """Mapping from a lever to one pilot pressure.

    Attributes:
        axis: 0 boom, 1 arm, 2 bucket.
        second: whether it is that of a conflux spool.
        extend: whether positive levers give it.
        share: fraction of the demand for a conflux spool; 1 for others.
    """

    axis: int
    second: bool
    extend: bool
    share: float


@dataclass(frozen=True, eq=False)
class PlanParts:
    """A plan on a twin.

    Attributes:
        plant: the twin as a bundle.
        blocks: length of each block of the horizon in samples.
        pilots: the twin's commands, in its order.
        lever_shape: full pressure (Pa), dead zone of levers, demand at which conflux begins.
        ports: answer of the twin that each measured value is.
        strokes: answers that are the strokes.
        velocities: answers that are the velocities of boom, arm and bucket.
        pressures: answers that are limited.
        sides: speeds (m/s) and levers of the continuous inverse map, by axis, extending and retracting.
        slowest: least speed (m/s) that a lever's range gives, shape (3,).
        fastest: largest, shape (3,).
        step_m_s: step of a speed to determine its effect, m/s.
        window: ticks over which predictions are compared with what was measured.
        weights: along, attitude_m, change, feedforward, trust_m_s, smoothing, as `nmpc` has them.
        margin: share of a stroke that is to stay free at either end.
        pressure_pa: largest cylinder pressure.
        fallback: whether the PI loop answers where the plan has no solution.
        iterations: most of the solver, a tick.
        load: share of a new error of the velocities that forces against the cylinders take over, of a grey box.
        newton: most iterations of a grey box's equations, a tick.
    """

    plant: Bundle
    blocks: tuple[int, ...]
    pilots: tuple[PilotCommand, ...]
    lever_shape: tuple[float, float, float]
    ports: tuple[int, ...]
    strokes: tuple[int, ...]
    velocities: tuple[int, ...]
    pressures: tuple[int, ...]
    sides: Sequence[tuple[Side, Side]]
    slowest: Array
    fastest: Array
    step_m_s: float
    window: int
    weights: tuple[float, float, float, float, float, float]
    margin: float
    pressure_pa: float
    fallback: bool
    iterations: int
    load: float
    newton: int

    @property
    def variables(self) -> int:
        """Number of optimisation variables of the plan."""
        return AXES * len(self.blocks)

    @property
    def rows(self) -> int:
        """Soft limits of the program, at most."""
        return len(self.blocks) * (AXES + len(self.pressures))

    @property
    def lane_ticks(self) -> int:
        """Ticks of the twin that are computed in a tick of the controller, with look-back and filter."""
        starts = np.cumsum(self.blocks) - self.blocks
        runs = sum(self.blocks) + AXES * sum(sum(self.blocks) - int(start) for start in starts)
        return runs + 1 + (self.window if self.weights[5] > 0.0 else 0)


@dataclass(frozen=True, eq=False)
class GoldenLoop:
    """Part of a closed loop run in Python, with which the C code is compared on a computer.

    Attributes:
        measured: values of the controller's inputs, shape (ticks, input).
        before: what it remembered before each tick, shape (ticks, number): levers; speeds of the plan, those asked for
            last (of a plan only); sums of the PI loop; disturbance, and forces against the cylinders (of a plan only).
        levers: levers of the controller, shape (ticks, 3).
        strokes: reference of the strokes (m), shape (rows, 3), at least as long as the ticks and the horizon.
        tip: reference of the tip, shape (rows, 3).
    """

    measured: Array
    before: Array
    levers: Array
    strokes: Array
    tip: Array


@dataclass(frozen=True, eq=False)
class ControllerParts:
    """A controller of boom, arm and bucket.

    Attributes:
        title: a line about it.
        machine: name of the machine.
        inputs: measured channels, in the order in which they are given; of a PI loop the three strokes.
        limits_low: lower limits of valid inputs, shape (input,). Values outside the limits count as missing.
        limits_high: upper limits of valid inputs, shape (input,).
        stroke_inputs: inputs that are the strokes.
        rate_hz: sampling rate in Hz.
        angles: joint angles (rad) at evenly spaced strokes, shape (nodes, 3).
        full_m: full strokes, shape (3,).
        lengths_m: lengths of the links, m, shape (3,).
        lever_low: least positions, shape (3,).
        lever_high: largest ones.
        slew: most that a lever moves in a tick, shape (3,).
        sides: speeds (m/s) and levers of the valve map, by axis, extending and retracting.
        gains: gains of the PI loop: proportional, integral, rest (m/s), maximum sum (m/s).
        lead: number of samples by which the PI loop reads the reference's speed in advance.
        plan: plan of a predictive controller; None for a PI loop alone.
        golden: data of a self-test; None without one.
    """

    title: str
    machine: str
    inputs: tuple[Channel, ...]
    limits_low: Array
    limits_high: Array
    stroke_inputs: tuple[int, ...]
    rate_hz: float
    angles: Array
    full_m: Array
    lengths_m: Array
    lever_low: Array
    lever_high: Array
    slew: Array
    sides: Sequence[tuple[Side, Side]]
    gains: tuple[float, float, float, float]
    lead: int
    plan: PlanParts | None
    golden: GoldenLoop | None
