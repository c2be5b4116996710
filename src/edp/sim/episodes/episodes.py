"""Episodes in rows: each has its own machine, soil and seed; all advance in one compiled call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.sim.episodes import blocks, tick
from edp.sim.faults import FaultSpec
from edp.sim.faults.course import MachineCourse, SensorCourse, numbers_of, shares_at, spare_s
from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.physics import soil
from edp.sim.physics.material import load_material
from edp.sim.physics.plant import Plant
from edp.sim.scenario import Scenario, SimulationError
from edp.sim.sensors import alterations, chain, draws
from edp.sim.start import seeds_of, start_of

Array = NDArray[np.float64]


_FAULTY = (
    blocks.AXES,
    blocks.PLANT,
    blocks.DELAYS,
    blocks.COARSE_FILTERS,
    blocks.FINE_FILTERS,
    blocks.SOIL_NUMBERS,
)
"""Blocks that machine faults change, in the order of `edp.sim.faults.course.BLOCKS`."""


@dataclass(frozen=True)
class EpisodeStart:
    """Start of an episode.

    Attributes:
        scenario: machine, soil, rate, seed and length; its excitation is not used.
        machine: machine parameters, which may be randomised or changed.
        hand: whether an operator's hand smooths the levers.
        loop_latency: delay of the observations in samples.
        lost_frames: fraction of the samples at which the previous observation is repeated.
        strokes: initial strokes as fractions of the full stroke; random if None.
    """

    scenario: Scenario
    machine: Machine
    hand: bool = False
    loop_latency: int = 0
    lost_frames: float = 0.0
    strokes: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Moment:
    """Snapshot of one episode: its rows, independent of later steps, and its start."""

    start: EpisodeStart
    columns: NDArray[np.int64]
    memory: Array
    drawn: Array


class Episodes:
    """Batch of running episodes, one machine per row.

    Args:
        count: number of machines.
        columns: observed columns, as indices of `tick.SOURCES`.

    Attributes:
        starts: start of each episode; None before the first reset.
        most_faults: largest number of faults of any episode.
    """

    def __init__(self, count: int, columns: NDArray[np.int64]) -> None:
        self.count, self.columns = count, columns
        self.memory, self.drawn = np.zeros((count, 0)), np.zeros((count, 0))
        self.starts: list[EpisodeStart | None] = [None] * count
        self.most_faults = 0
        self._scratch = tick.new_scratch()
        self._all = np.ones(count, dtype=np.bool_)

    def begin(self, index: int, start: EpisodeStart, out: tick.Out) -> None:
        """Restart an episode; its observation is written to `out`.

        Raises:
            ConfigError: the machine's dead times are too long.
        """
        memory, drawn = _rows(start, len(self.columns))
        self._put(index, start, memory, drawn)
        tick.begin(self.memory[index], self.drawn[index], self.columns, self._scratch, index, out)

    def new_out(self) -> tick.Out:
        """Return arrays for the results of `begin` and `step`.

        Observations, rows of the log, and which episodes have ended.
        """
        observations = np.empty((self.count, len(self.columns)), np.float32)
        return observations, np.empty((self.count, tick.LOG_WIDTH)), np.zeros(self.count, dtype=np.bool_)

    def step(self, levers: Array, out: tick.Out, active: NDArray[np.bool_] | None = None) -> None:
        """Advance the active episodes by one sample with levers of shape (count, 3); observations are written to `out`.

        Raises:
            ConfigError: a lever is not a finite number; no episode has moved.
            SimulationError: a state became non-finite.
        """
        active = self._all if active is None else active
        failed, how = tick.step_all(self.memory, self.drawn, levers, active, self.columns, self._scratch, out)
        if how == tick.FINE:
            return
        if how == tick.NOT_FINITE_LEVER:
            raise not_finite(levers, failed)
        start = self.starts[failed]
        if start is None:
            raise ConfigError(f"episode {failed} has not begun; reset it first")
        raise SimulationError(
            f"episode {failed} diverged at t = {self.ticks(failed) / start.scenario.rate_hz:.2f} s (machine "
            f"{start.machine.name}, seed {start.scenario.seed}); choose a smaller step_s than {start.scenario.step_s}"
        )

    def ticks(self, index: int) -> int:
        """Return the number of samples since the start of an episode."""
        return int(self.memory[index, blocks.BLOCKS * blocks.ENTRY + blocks.TICK])

    def shares(self) -> Callable[[], Array] | None:
        """Return a function that computes the present fraction of each fault; None without faults.

        The fractions are from 0 to 1, shape (episode, fault); NaN in columns without a fault.
        """
        if self.most_faults == 0:
            return None
        plans = tuple(
            ((), 1.0) if start is None else (start.scenario.faults, start.scenario.rate_hz) for start in self.starts
        )
        ticks = self.memory[:, blocks.BLOCKS * blocks.ENTRY + blocks.TICK].astype(np.int64)
        # A class instead of a closure, because the object is sent between processes.
        return partial(_shares_of, plans, ticks, self.most_faults)

    def ended(self, index: int) -> bool:
        """Return whether an episode has all its ticks behind it."""
        first = blocks.BLOCKS * blocks.ENTRY
        return bool(self.memory[index, first + blocks.TICK] >= self.memory[index, first + blocks.SAMPLES] - 1.0)

    def moment(self, index: int) -> Moment:
        """Return a snapshot of an episode."""
        start = self.starts[index]
        if start is None:
            raise ConfigError(f"episode {index} has not begun; reset it first")
        # The row of random values is replaced and never changed, so that it needs no copy.
        drawn = self.drawn[index] if self.count == 1 else self.drawn[index].copy()
        return Moment(start, self.columns, self.memory[index].copy(), drawn)

    def go_to(self, index: int, moment: Moment) -> None:
        """Restore an episode to a snapshot, bit for bit.

        Raises:
            ConfigError: the moment is of episodes that show other channels.
        """
        if not np.array_equal(moment.columns, self.columns):
            raise ConfigError(
                "the snapshot is of an environment that shows other channels; give both the same 'observed'"
            )
        self._put(index, moment.start, moment.memory.copy(), moment.drawn)

    def show(self, index: int, out: tick.Out) -> None:
        """Write the last observation of an episode to `out`."""
        observations, rows, ended = out
        observations[index] = blocks.view(blocks.SHOWN, self.memory[index], self.drawn[index])[-1]
        row = blocks.view(blocks.ROW, self.memory[index], self.drawn[index])[0]
        rows[index], rows[index, : len(row)] = np.nan, row
        ended[index] = self.ended(index)

    def redraw(self, index: int, seed: np.random.SeedSequence) -> None:
        """Draw new random values for sensors and soil; the present observation and soil contact are unchanged."""
        start = self.starts[index]
        if start is None:
            raise ConfigError(f"episode {index} has not begun; reset it first")
        noise, lost, course, chance = seed.spawn(4)
        drawn, done = self.drawn[index].copy(), self.ticks(index) + 1
        present = blocks.view(blocks.SENSOR_DRAWS, self.memory[index], drawn)
        if start.scenario.sensor_noise or present.shape[1] > chain.DRAWS:
            fresh = _sensor_draws(start, noise, chance)
            _bridge(present, fresh, done, len(blocks.view(blocks.HISTORY, self.memory[index], drawn)))
        losses = blocks.view(blocks.LOST, self.memory[index], drawn)[0]
        losses[done:] = _losses(start, len(losses), lost)[done:]
        if start.scenario.material:
            soil.redraw_course(
                load_material(start.scenario.material),
                blocks.view(blocks.SOIL_NUMBERS, self.memory[index], drawn)[0],
                blocks.view(blocks.GROUND_MEMORY, self.memory[index], drawn)[0],
                blocks.view(blocks.SOIL_COURSE, self.memory[index], drawn),
                np.random.default_rng(course),
            )
        self._put(index, start, self.memory[index].copy(), drawn)

    def _put(self, index: int, start: EpisodeStart, memory: Array, drawn: Array) -> None:
        """Set the rows of an episode; all rows are extended to the longest."""
        self.starts[index] = start
        self.most_faults = max(len(each.scenario.faults) for each in self.starts if each is not None)
        if self.count == 1:
            self.memory, self.drawn = memory[None], drawn[None]
            return
        self.memory, self.drawn = _long_enough(self.memory, len(memory)), _long_enough(self.drawn, len(drawn))
        self.memory[index, : len(memory)], self.drawn[index, : len(drawn)] = memory, drawn


def not_finite(levers: Array, index: int) -> ConfigError:
    """Return the error for levers, shape (episode, 3), that are not finite in one episode."""
    return ConfigError(
        f"levers of episode {index} are not finite: {levers[index].tolist()}; expected finite numbers from -1 to 1: "
        "give three finite positions, boom, arm and bucket"
    )


def _long_enough(rows: Array, length: int) -> Array:
    if rows.shape[1] >= length:
        return rows
    longer = np.zeros((len(rows), length))
    longer[:, : rows.shape[1]] = rows
    return longer


def _bridge(present: Array, fresh: Array, done: int, depth: int) -> None:
    """Replace the draws of the ticks from `done` on, in place.

    Sensor biases continue from their current value. No frame is older than the previous frame or older than the `depth`
    samples that the sensors store.
    """
    late = slice(chain.AT_JOINTS, chain.AT_VALVES + 1)
    earliest = (np.arange(len(present)) - (depth - 1.0))[:, None]
    present[done:, late] = np.maximum(np.maximum(fresh[done:, late], earliest[done:]), present[done - 1, late])
    bias, errors = slice(chain.RATE_BIAS, chain.RATE_ERROR), slice(chain.RATE_ERROR, None)
    present[done:, bias] = present[done - 1, bias] + fresh[done:, bias] - fresh[done - 1, bias]
    present[done:, errors] = fresh[done:, errors]


def _shares_of(plans: Sequence[tuple[tuple[FaultSpec, ...], float]], ticks: NDArray[np.int64], most: int) -> Array:
    """Return the current fraction of each fault in several episodes, shape (episode, fault)."""
    shares = np.full((len(plans), most), np.nan)
    for index, (faults, rate_hz) in enumerate(plans):
        shares[index, : len(faults)] = shares_at(faults, ticks[index : index + 1], rate_hz)[0]
    return shares


def _sensor_draws(start: EpisodeStart, noise: np.random.SeedSequence, chance: np.random.SeedSequence) -> Array:
    """Return the random values of the sensors of an episode and of their faults, shape (samples, columns)."""
    scenario = start.scenario
    rng = np.random.default_rng(noise) if scenario.sensor_noise else None
    healthy = draws.draw(start.machine, scenario.samples, scenario.rate_hz, rng)
    return SensorCourse(scenario.faults).drawn(healthy, scenario.rate_hz, np.random.default_rng(chance))


def _losses(start: EpisodeStart, samples: int, seed: np.random.SeedSequence) -> Array:
    """Return 1 at each tick whose observation is lost, shape (samples,)."""
    if start.lost_frames <= 0.0:
        return np.zeros(samples)
    return (np.random.default_rng(seed).random(samples) < start.lost_frames).astype(float)


def _changes(start: EpisodeStart, plant: Plant) -> Array:
    """Return the changes of plant parameters by faults, in the form of the change block."""
    changes = MachineCourse(start.scenario.faults, numbers_of(plant)).changes(start.scenario.samples)
    changes[:, blocks.BLOCK] = np.array(_FAULTY, dtype=float)[changes[:, blocks.BLOCK].astype(np.int64)]
    return changes


def _sensor_parts(start: EpisodeStart) -> dict[int, Array]:
    """Return the blocks of the sensors, their draws and their faults."""
    scenario, seeds = start.scenario, seeds_of(start.scenario)
    drawn = _sensor_draws(start, seeds[2], seeds[4])
    faults = SensorCourse(scenario.faults).table
    numbers, axes, plant, table = draws.pack_sensors(start.machine, scenario.rate_hz, scenario.sensor_noise, faults)
    return {
        blocks.SENSOR_NUMBERS: numbers,
        blocks.SENSOR_AXES: axes,
        blocks.SENSOR_PLANT: plant,
        blocks.SENSOR_MEMORY: np.zeros(chain.SENSOR_MEMORY),
        blocks.HISTORY: np.zeros((draws.depth(drawn), chain.REMEMBERED)),
        blocks.MEASURED: np.zeros(chain.SENSED),
        blocks.SENSOR_FAULTS: table,
        blocks.FAULT_MEMORY: np.zeros(alterations.memory_shape(faults, drawn[:, chain.DRAWS :])),
        blocks.SENSOR_DRAWS: drawn,
    }


def _rows(start: EpisodeStart, width: int) -> tuple[Array, Array]:
    """Return both rows of an episode in steady state at its start; `width` is the number of observations."""
    scenario, machine = start.scenario, start.machine
    ground, strokes = start_of(scenario, machine)
    if start.strokes is not None:
        strokes = np.array(start.strokes)
    plant = Plant(machine, strokes, scenario.rate_hz, scenario.step_s, ground, spare_s(scenario.faults))
    if len(plant.past) > tick.MAX_PAST:
        raise ConfigError(
            f"machine {machine.name} has dead times of {len(plant.past)} ticks at {scenario.rate_hz} Hz; at most "
            f"{tick.MAX_PAST} are taken: choose a lower rate_hz"
        )
    coarse, fine = plant.clocks
    soil_numbers, tables, course, heights, ground_memory = soil.no_ground() if ground is None else ground.arrays()
    columns = at.LOG_COLUMNS if ground is None else at.LOG_GROUND + at.GROUND_POINTS
    numbers = [
        0.0,
        scenario.samples,
        0.0,
        1.0 / scenario.rate_hz if start.hand else 0.0,
        ground is None,
        start.loop_latency,
        0.0,
    ]
    parts = {
        blocks.NUMBER: np.array(numbers, dtype=float),
        blocks.STATE: plant.state,
        blocks.VALVES: plant.valves,
        blocks.HAND: plant.hand,
        blocks.PAST: plant.past,
        blocks.AXES: plant.axes,
        blocks.PLANT: plant.plant,
        blocks.DELAYS: plant.delays,
        blocks.COARSE: np.array(coarse[:3]),
        blocks.FINE: np.array(fine[:3]),
        blocks.COARSE_FILTERS: coarse[3].reshape(at.SPOOLS, -1),
        blocks.FINE_FILTERS: fine[3].reshape(at.SPOOLS, -1),
        blocks.HEIGHTS: heights,
        blocks.GROUND_MEMORY: ground_memory,
        blocks.ROW: np.zeros((1, columns)),
        blocks.SHOWN: np.zeros((start.loop_latency + 2, width)),
        blocks.LOST: _losses(start, scenario.samples, seeds_of(scenario)[1]),
        blocks.SOIL_NUMBERS: soil_numbers,
        blocks.SOIL_TABLES: tables,
        blocks.SOIL_COURSE: course,
        blocks.CHANGES: _changes(start, plant),
    }
    return blocks.rows_of(parts | _sensor_parts(start))
