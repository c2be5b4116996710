"""Swing and travel of one plant: motor parameters, state and commands; see `motors`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine, Motor, SwingMotor
from edp.sim.machine.parameters import conductance
from edp.sim.physics import valve
from edp.sim.physics.commands import shape_motor_commands
from edp.sim.physics.motors import SLOPES, Motors

Array = NDArray[np.float64]


def motors_of(machine: Machine) -> tuple[SwingMotor, Motor, Motor]:
    """Return the motors of swing, left and right track.

    Raises:
        ConfigError: the machine has none.
    """
    if machine.swing is None or machine.travel is None:
        raise ConfigError(
            f"machine {machine.name} neither swings nor travels: its file has no [swing] and [travel]; copy both "
            "tables from M22's or C14's and change their numbers, or choose a way of driving without them"
        )
    return machine.swing, machine.travel, machine.travel


def pack_motors(machine: Machine) -> Array:
    """Return the parameters of the motors of a machine, shape (3, MOTOR_VALUES)."""
    numbers, motors = np.zeros((at.MOTORS, at.MOTOR_VALUES)), motors_of(machine)
    for row, motor in zip(numbers, motors, strict=True):
        row[: at.FOOT_AHEAD] = (
            *(motor.pump - 1, motor.displacement, motor.inertia, motor.volume, motor.leakage, motor.drain_leakage),
            *(motor.coulomb, motor.viscous, motor.brake, motor.brake_delay, motor.relief, motor.relief_slope),
            *(motor.dead_band, motor.pump_demand, conductance(motor.meter_in), conductance(motor.meter_out)),
        )
    numbers[2, at.MOTOR_PUMP] = 1.0 - numbers[1, at.MOTOR_PUMP]
    numbers[0, at.FOOT_AHEAD] = motors[0].boom_foot_ahead
    return numbers


def filters_of(machine: Machine, half_s: float) -> Array:
    """Return the transitions of pilots and spools of the motors over half a step, shape (3, 2, 4)."""
    return np.array(
        [
            [
                valve.oscillator(motor.pilot_frequency, valve.PILOT_DAMPING, half_s),
                valve.oscillator(motor.spool_frequency, valve.SPOOL_DAMPING, half_s),
            ]
            for motor in motors_of(machine)
        ]
    )


class MotorCircuit:
    """Swing and travel of one plant: parameters, state and past commands.

    Args:
        machine: machine with `swing` and `travel`.
        rate_hz: rate of commands.
        half_steps_s: half of a coarse and of a fine step.
    """

    def __init__(self, machine: Machine, rate_hz: float, half_steps_s: tuple[float, float]) -> None:
        self.numbers = pack_motors(machine)
        self.state = np.zeros((at.MOTORS, at.MOTOR_STATES))
        # Parked: the brakes are on.
        self.state[:, at.IDLE] = self.numbers[:, at.BRAKE_DELAY]
        self.state[:, [at.PORT_A, at.PORT_B]] = machine.oil.tank_pressure
        self.valves = np.zeros((at.MOTORS, 5))
        self.hand = np.zeros((at.MOTORS, 2))
        self.past = np.zeros((0, at.MOTORS))
        self._zone = machine.valves.lever_dead_zone
        self.delays = np.array([motor.dead_time for motor in motors_of(machine)]) * rate_hz
        self.filters = tuple(filters_of(machine, half_s) for half_s in half_steps_s)
        square = (np.zeros((at.MOTORS, at.MOTOR_STATES)) for _ in range(5))
        self._work = np.zeros((at.MOTORS, 4)), np.zeros(4), np.zeros((at.MOTORS, SLOPES)), *square
        self._held = np.zeros(at.MOTORS)

    @property
    def swing(self) -> tuple[float, float]:
        """Angle (rad) and rate (rad/s) of the upper structure."""
        return float(self.state[0, at.WAY]), float(self.state[0, at.SPEED])

    @property
    def memory(self) -> tuple[Array, ...]:
        """Every array that changes over time, live."""
        return self.state, self.valves, self.hand, self.past

    def demands_of(self, levers: Array, hand_s: float) -> Array:
        """Return the demands of levers, shape (samples, 3), after the past demands, which are updated.

        The operator's hand smooths the levers in steps of `hand_s`; 0 omits the smoothing.
        """
        demands, shaped = np.empty((len(self.past) + len(levers), at.MOTORS)), np.empty(at.MOTORS)
        shape_motor_commands(levers, self.hand, hand_s, self.past, self._zone, demands, shaped)
        return demands

    def arrays(self, demands: Array, log: Array) -> Motors:
        """Return the arguments of the compiled code, with demands after the past ones and the log of a run."""
        return (
            *(self.numbers, self.state, self.valves, *self._work),
            *(demands, self.delays, self._held, *self.filters, log),
        )
