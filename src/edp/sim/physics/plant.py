"""Plant: arrays, steady state, and simulation sample by sample."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.machine.parameters import pack
from edp.sim.physics import dynamics, engine, integrator, lines, linkage, soil, terrain, terramechanics, thermal, valve
from edp.sim.physics import motors as places
from edp.sim.physics.commands import shape_commands
from edp.sim.physics.jit import compiled, inlined
from edp.sim.physics.motor_circuit import MotorCircuit
from edp.sim.physics.motors import Motors
from edp.sim.physics.scratch import MovingParts, SpoolCommands
from edp.sim.sensors import logbook

Array = NDArray[np.float64]

FINE = 4
"""Number of substeps of a step near the ends of the stroke, where cushions and stops are stiff."""
RESTING_PRESSURE = 10e5
"""Initial pressure of pump lines and of the less loaded chamber, Pa. It prevents a start in vacuum."""
Clock = tuple[int, float, float, Array]


@compiled
def is_near_end(row: Array, axes: Array) -> bool:
    """Return whether any cylinder of a logged sample runs into a cushion, or moves at a stop."""
    for i in range(at.AXES):
        v, stroke = row[at.LOG_VELOCITY + i], row[at.LOG_STROKE + i]
        ahead = axes[i, at.STROKE] - stroke if v > 0.0 else stroke
        # 20 ms of travel ahead, since the choice of the clock holds for a whole sample.
        braking = abs(v) > 1e-2 and ahead < axes[i, at.CUSHION_LENGTH] + 0.02 * abs(v)
        # A cylinder that rests at its stop is not stiff: only motion there needs fine steps.
        touching = abs(v) > 1e-3 and min(stroke, axes[i, at.STROKE] - stroke) < 1e-3
        if braking or touching:
            return True
    return False


@inlined
def run_sample(
    moving: MovingParts,
    commands: SpoolCommands,
    newest: int,
    times: tuple[Array, tuple[Clock, Clock]],
    setup: tuple[Array, Array, tuple[Array, ...], tuple[Array, ...]],
    row: Array,
    motors: Motors | None = None,
) -> int:
    """Simulate from the logged sample `row` to the next sample; return the number of clamped pressures.

    `newest` is the row of the demands that belongs to the sample; the rest as in `run_samples`.
    """
    state, (demands, held_commands) = moving.state, commands
    delays, clocks = times
    axes, plant, work, ground = setup
    # Steps in a sample times their length: fine and coarse clocks give the same.
    time_s = clocks[0][0] * clocks[0][1]
    # Once a sample: the oil's temperature changes over minutes.
    thermal.warm(row, axes, plant, time_s, motors)
    # Once a sample, too: governor and inertia make tens of milliseconds.
    engine.turn(row, plant, time_s)
    near, fine = False, is_near_end(row, axes)
    if ground[0][terramechanics.ACTIVE] > 0.0:
        near, touching = terrain.look(row, time_s, axes, ground)
        fine = fine or touching
    integrator.begin_sample(state, work)
    clamps = 0
    steps, step_s, share, filters = clocks[1] if fine else clocks[0]
    for n in range(steps):
        for j in range(at.SPOOLS):
            # whole samples of delay, plus the part of a sample that is left, at mid-step
            when = newest + (n + 0.5) / steps - delays[j]
            held_commands[j] = demands[max(int(np.floor(when)), 0), j]
        clock = (step_s, share, filters)
        if motors is None:
            clamps += integrator.step(moving, held_commands, clock, setup, near)
        else:
            places.hold_commands(motors, newest + (n + 0.5) / steps)
            clamps += integrator.step(moving, held_commands, clock, setup, near, motors, fine)
    return clamps


@compiled
def run_samples(
    moving: MovingParts,
    commands: SpoolCommands,
    times: tuple[Array, tuple[Clock, Clock]],
    setup: tuple[Array, Array, tuple[Array, ...], tuple[Array, ...]],
    log: Array,
    motors: Motors | None = None,
) -> int:
    """Run one sample per row of `log`; returns the number of clamped pressures.

    The first rows of the demands are past demands; the last rows belong to `log`. `times` contains delays in samples,
    the number of steps per sample, and the clock of one step, for coarse and for fine steps. Optional `motors` write
    into a separate log.
    """
    demands = commands.demands
    first = demands.shape[0] - log.shape[0]
    clamps = 0
    for k in range(log.shape[0]):
        # Logged before the steps: row k is the instant at which lever k is applied.
        logbook.write_log(moving, demands[first + k], setup, log[k], motors)
        if motors is not None:
            places.write_log(motors, k, first + k)
        clamps += run_sample(moving, commands, first + k, times, setup, log[k], motors)
    return clamps


def steps_per_sample(rate_hz: float, step_s: float) -> int:
    """Return the whole number of integration steps that fill a sample.

    Raises:
        ConfigError: there is none.
    """
    steps = round(1.0 / (rate_hz * step_s))
    # 1e-9 allows for the rounding of decimal steps such as 0.0001 only.
    if steps < 1 or abs(steps * step_s * rate_hz - 1.0) > 1e-9:
        raise ConfigError(
            f"step_s = {step_s} s does not divide the sample time {1.0 / rate_hz} s of rate_hz = {rate_hz}; "
            "choose a step such as 0.001 or 0.0005"
        )
    return steps


class Plant:
    """One machine in motion: levers in, logged samples out.

    Args:
        machine: the parameter set.
        strokes: initial strokes as fractions of each cylinder's stroke, shape (3,).
        rate_hz: logging and command rate.
        step_s: integration step, s; the sample time must be a multiple of it.
        ground: ground that the bucket digs in; None in free air.
        spare_s: maximum dead time that can be added during the simulation, s.
        moves: whether swing and travel move, too; without them both do not move and take no oil.

    Raises:
        ConfigError: the step does not divide the sample time, or the machine has no motors that could move.
    """

    def __init__(
        self,
        machine: Machine,
        strokes: Array,
        rate_hz: float = 100.0,
        step_s: float = 1e-3,
        ground: soil.Ground | None = None,
        spare_s: float = 0.0,
        moves: bool = False,
    ) -> None:
        steps = steps_per_sample(rate_hz, step_s)
        self.machine = machine
        self.rate_hz = rate_hz
        self.axes, self.plant = pack(machine)
        self.state = resting_state(strokes, self.axes, self.plant)
        self.valves = np.zeros((at.SPOOLS, 5))
        self.hand = np.zeros((at.AXES, 2))
        self.work = integrator.new_work()
        self._held = np.zeros(at.SPOOLS)
        # An array of one value, since a snapshot restores arrays in place.
        self._counts = np.zeros(1, dtype=np.int64)
        self.ground = ground
        self._ground = soil.no_ground() if ground is None else ground.arrays()
        self.delays = valve.dead_times(machine) * rate_hz
        # One sample more than the longest dead time: a delay between samples reads the older one.
        self._past = int(np.ceil(self.delays.max() + spare_s * rate_hz)) + 1
        self.motors: MotorCircuit | None = None
        if moves:
            self.motors = MotorCircuit(machine, rate_hz, (0.5 * step_s, 0.5 * step_s / FINE))
            self._past = max(self._past, int(np.ceil(self.motors.delays.max())) + 1)
            self.motors.past = np.zeros((self._past, at.MOTORS))
        self._demands = np.zeros((self._past, at.SPOOLS))
        coarse, fine = ((n * steps, *integrator.clock_of(machine, step_s / n)) for n in (1, FINE))
        self.clocks = coarse, fine

    @property
    def strokes(self) -> Array:
        """Strokes as fractions of each cylinder's full stroke, shape (3,)."""
        lengths = [linkage.cylinder(i, self.state[at.PSI + i], self.plant)[0] for i in range(at.AXES)]
        return (np.array(lengths) - self.axes[:, at.CLOSED]) / self.axes[:, at.STROKE]

    @property
    def engine_speed(self) -> float:
        """Engine speed as a fraction of the governed speed; 1 without droop."""
        return float(self.plant[at.ENGINE_SPEED])

    @property
    def past(self) -> Array:
        """Demands of the last samples, the newest last, shape (samples, 6), live."""
        return self._demands

    @property
    def soil_numbers(self) -> Array:
        """Numbers of bucket and soil, live; zeros in free air."""
        return self._ground[0]

    @property
    def payload_kg(self) -> float:
        """Soil in the bucket; 0 in free air."""
        return 0.0 if self.ground is None else self.ground.payload_kg

    @property
    def memory(self) -> tuple[NDArray[Any], ...]:
        """Every array that changes over time, live; copying and restoring them gives an exact restart."""
        changing = (self.state, self.valves, self.hand, self._demands, self.axes, self.plant, self._counts)
        # Tables and course are read only while the plant runs.
        motors = () if self.motors is None else self.motors.memory
        return (*changing, self._ground[0], *self._ground[3:], *motors)

    @property
    def finite(self) -> bool:
        """Whether every state is finite; a non-finite state persists."""
        # One sum instead of a test of each value: NaN and infinity survive every addition.
        turning = 0.0 if self.motors is None else float(self.motors.state.sum())
        return math.isfinite(sum(self.state.tolist()) + turning)

    @property
    def clamps(self) -> int:
        """Number of pressures raised to the floor until now."""
        return int(self._counts[0])

    def run(self, levers: Array) -> Array:
        """Run one sample per row of lever positions, shape (samples, 3), in [-1, 1]; returns the log.

        The log has shape (samples, columns of `edp.sim.machine.layout`); row k is the state at the instant at which
        lever k is applied. Where swing and travel move, levers may have three columns more: swing, left, right track.

        Raises:
            ConfigError: levers of another shape.
        """
        return self._advance(levers, 0.0)

    def follow(self, targets: Array) -> Array:
        """Simulate like `run`, with the operator's hand between targets and levers."""
        return self._advance(targets, 1.0 / self.rate_hz)

    def drive(self, demands: Array) -> Array:
        """Run like `run`, with signed spool demands as in logs, shape (samples, 6), as fractions of full scale."""
        every = np.concatenate([self._demands, demands])
        # In place, since a snapshot restores arrays in place.
        self._demands[:] = every[len(every) - self._past :]
        return self._advance_samples(every)

    def rest_at(self, demands: Array) -> None:
        """Set pilots and spools to the steady state of these demands, shape (6,)."""
        self._demands[:] = demands
        self.valves[:] = 0.0
        for column in (at.PILOT, at.PLAY, at.SPOOL):
            self.valves[:, column] = demands

    def place(self, strokes: Array, velocities: Array, pressures: Array) -> None:
        """Set cylinders and oil to measured values; valves, displacements and friction keep their state.

        Oil in long lines begins in steady state, at the chambers' pressures.

        Args:
            strokes: strokes of the cylinders, m, shape (3,); limited to the stroke range.
            velocities: velocities of the cylinders, m/s, shape (3,).
            pressures: pressures of head chambers, rod chambers and pump lines, Pa, shape (8,); NaN leaves a pressure
                unchanged.
        """
        for i in range(at.AXES):
            within = min(max(float(strokes[i]), 0.0), float(self.axes[i, at.STROKE]))
            psi = linkage.angle_at_stroke(i, within, self.axes, self.plant)
            self.state[at.PSI + i] = psi
            self.state[at.RATE + i] = velocities[i] / linkage.cylinder(i, psi, self.plant)[1]
        finite = np.isfinite(pressures)
        self.state[at.HEAD : at.BRISTLE][finite] = np.maximum(pressures[finite], at.LOWEST_PRESSURE)
        lines.rest(self.state, self.plant)

    def _advance(self, levers: Array, hand_s: float) -> Array:
        """Run with levers smoothed by the hand at steps of `hand_s`; 0 for unsmoothed levers."""
        setup = (self.axes, self.plant, self.work, self._ground)
        demands = np.empty((len(levers) + self._past, at.SPOOLS))
        levers = np.asarray(levers, dtype=float)
        widths = (at.AXES,) if self.motors is None else (at.AXES, at.AXES + at.MOTORS)
        if levers.ndim != 2 or levers.shape[1] not in widths:
            raise ConfigError(
                f"levers of shape {levers.shape}; give (samples, {' or '.join(map(str, widths))}): boom, arm, bucket"
                + ("" if self.motors is None else ", and swing, left and right track")
            )
        front = np.ascontiguousarray(levers[:, : at.AXES])
        shape_commands(front, self.hand, hand_s, self._demands, setup, demands, self._held)
        if self.motors is None:
            return self._advance_samples(demands)
        others = np.zeros((len(levers), at.MOTORS))
        others[:, : levers.shape[1] - at.AXES] = levers[:, at.AXES :]
        return self._advance_samples(demands, self.motors.demands_of(others, hand_s))

    def _advance_samples(self, demands: Array, motor_demands: Array | None = None) -> Array:
        """Run with demands appended to the past ones; without motor demands swing and travel do not move."""
        setup = (self.axes, self.plant, self.work, self._ground)
        samples = len(demands) - self._past
        log = np.empty((samples, at.LOG_COLUMNS if self.ground is None else at.LOG_GROUND + at.GROUND_POINTS))
        times = (self.delays, self.clocks)
        moving, commands = MovingParts(self.state, self.valves), SpoolCommands(demands, self._held)
        if self.motors is None:
            self._counts[0] += run_samples(moving, commands, times, setup, log)
            return log
        if motor_demands is None:
            motor_demands = self.motors.demands_of(np.zeros((samples, at.MOTORS)), 0.0)
        turned = np.empty((samples, at.MOTOR_COLUMNS))
        motors = self.motors.arrays(motor_demands, turned)
        self._counts[0] += run_samples(moving, commands, times, setup, log, motors)
        return np.hstack((log, turned))


def resting_state(strokes: Array, axes: Array, plant: Array) -> Array:
    """Return the equilibrium state at these strokes (fractions of full stroke), shape (STATES,)."""
    state = np.zeros(at.STATES)
    for i in range(at.AXES):
        state[at.PSI + i] = linkage.angle_at_stroke(i, strokes[i] * axes[i, at.STROKE], axes, plant)
    psi, load = state[at.PSI : at.PSI + 3], np.empty(3)
    dynamics.gravity_torque(psi, axes, plant[at.GRAVITY], load)
    for i in range(at.AXES):
        force = load[i] / linkage.cylinder(i, psi[i], plant)[1]
        # Equilibrium fixes only the difference of the pressures; the lower one is set.
        head = (force + axes[i, at.ROD_AREA] * RESTING_PRESSURE) / axes[i, at.HEAD_AREA]
        rod = RESTING_PRESSURE
        if head < RESTING_PRESSURE:
            head = RESTING_PRESSURE
            rod = (axes[i, at.HEAD_AREA] * head - force) / axes[i, at.ROD_AREA]
        state[at.HEAD + i], state[at.ROD + i] = head, rod
    state[at.PUMP : at.PUMP + 2] = RESTING_PRESSURE
    state[at.DISPLACEMENT : at.DISPLACEMENT + 2] = plant[at.MIN_DISPLACEMENT]
    lines.rest(state, plant)
    return state
