"""Grey box with on-board adaptation: wear and temperature are learned from its own free runs, within bounds.

An observer follows the machine as in `edp.networks.twin.forecast`. Every `learn_ticks` samples, the last segment is
simulated again from the observer's state at its start with the measured commands: once with the present parameters,
and once for each *group* of parameters with a small increase. e are the velocity errors divided by their recent root
mean square, S the derivatives of the simulation with respect to the logarithms x of the groups, P the covariance of x::

    P = (P^-1 + S' S / n)^-1,  x = x + P S' clip(e) / n,   n ticks of the segment, whose errors count as one tick's
    x = a x,  P = a^2 P + (1 - a^2) prior,                 a = exp(-learn_ticks / forgetting)

which is a Kalman filter on parameters that decay to their initial values. Forces without a parameter, such as soil
forces, are estimated in each sample (`DisturbanceObserver`). A forecast runs from the observer's state with the current
parameters and forces.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.networks.twin.base import Twin, TwinState
from edp.networks.twin.disturbance_observer import DisturbanceObserver
from edp.networks.twin.greybox import GreyTwin
from edp.registry import Registry
from edp.settings.bounds import above, check_bounds, integer, span
from edp.wording import typed

Array = NDArray[np.float32]
Doubles = NDArray[np.float64]
STEP = 0.02
"""Relative step of a group to determine its effect: large compared with rounding, small compared with curvature."""
CLIP = 3.0
"""Error in scaled units at which errors are clipped, so that outliers do not change the parameters more."""
BOUND = 3.0
"""Maximum change of a parameter group, in prior standard deviations."""
LEAST = 1e-3
"""Minimum error for adaptation, as a fraction of the velocity's standard deviation."""
LATELY = 30
"""Number of recent segments over which errors are averaged."""
HOTTEST_C = 150.0
"""Maximum plausible oil temperature, degC. A higher reading counts as a sensor fault."""
WARMER = 0.02
"""Change of a parameter's logarithm with temperature at which the parameters are computed again: about one kelvin."""
REST = 1e-3
"""Minimum speed (m/s or rad/s) of a segment that identifies valves and friction."""


@dataclass(frozen=True, kw_only=True)
class NumberGroup:
    """Parameters of a grey box that are scaled by a common factor.

    Attributes:
        powers: power of the group's factor that multiplies the parameters of a name prefix, by prefix.
        deviation: prior standard deviation of the logarithm of the factor.
        shared: whether all actuators share one group; otherwise each actuator has a group that includes its valves.
        per_kelvin: change of the logarithm per kelvin of oil temperature, if that is measured.
    """

    powers: Mapping[str, float]
    deviation: float
    shared: bool = False
    per_kelvin: float = 0.0


NUMBER_GROUPS: Registry[NumberGroup] = Registry("group of numbers")
NUMBER_GROUPS.register("dead_band")(NumberGroup(powers={"dead_band_": 1.0}, deviation=0.25))
NUMBER_GROUPS.register("gain")(NumberGroup(powers={"into_": 1.0, "out_of_": 1.0}, deviation=0.15))
NUMBER_GROUPS.register("friction")(NumberGroup(powers={"viscous": 1.0}, deviation=0.5))
# The factor is that of the viscosity, which of mineral oil falls by some 3.5 % a K about 40 degC: leakage goes with its
# inverse, friction in seals and bearings with about its root, and the modulus falls by some 0.4 % a K.
OIL = {"piston_leakage": -1.0, "spool_leakage": -1.0, "viscous": 0.5, "bulk_modulus": 0.114}
NUMBER_GROUPS.register("oil")(NumberGroup(powers=OIL, deviation=1.0, shared=True, per_kelvin=-0.035))


@dataclass(frozen=True, kw_only=True)
class TunedSpec:
    """Speed and limits of the parameter adaptation.

    Attributes:
        groups: names in `NUMBER_GROUPS` of the groups to adapt.
        learn_ticks: length of a segment that is run again.
        forgetting_s: time constant of forgetting, in seconds of motion.
        gain: gain of the observer, as a fraction of the innovation.
        load_share: fraction of a new force that the estimate adopts per sample; 0 to estimate no forces.
        oil_c: oil temperature (degC) in the recordings of the twin's fit, for samples with a measured oil temperature;
            NaN if unknown.

    Raises:
        ConfigError: a value out of range or a group that does not exist.
    """

    groups: tuple[str, ...] = ("dead_band", "gain", "friction", "oil")
    learn_ticks: int = 20
    forgetting_s: float = 60.0
    gain: float = 0.3
    load_share: float = 0.15
    oil_c: float = math.nan

    def __post_init__(self) -> None:
        check_bounds("tuning", self, learn_ticks=integer(2, 1000), forgetting_s=above(0.0, 1e6), gain=span(0.0, 1.0),
                     load_share=span(0.0, 1.0))  # fmt: skip
        if not (math.isnan(self.oil_c) or abs(self.oil_c) <= HOTTEST_C):
            raise ConfigError(
                f"tuning: oil_c = {self.oil_c}; degrees Celsius within {typed(HOTTEST_C)}, or NaN, must hold"
            )
        for name in self.groups:
            NUMBER_GROUPS[name]
        if not self.groups:
            raise ConfigError(f"tuning: groups is empty; name at least one of {', '.join(NUMBER_GROUPS)}")


def group_matrix(twin: GreyTwin, groups: Sequence[str]) -> tuple[tuple[str, ...], Doubles, Doubles, Doubles]:
    """Return labels, parameters moved by each group ``(number, group)``, deviations, changes per kelvin ``(group,)``.

    Raises:
        ConfigError: the twin has no number of a group.
    """
    owner = {valve.name: valve.actuator for valve in twin.spec.elements(twin.channels).valves}
    labels: list[str] = []
    columns, deviations, warmth = [], [], []
    for kind in groups:
        group = NUMBER_GROUPS[kind]
        by_element: dict[str, Doubles] = {}
        for index, number in enumerate(twin.table.numbers):
            power = next((power for name, power in group.powers.items() if number.name.startswith(name)), None)
            if power is not None and number.positive:
                element = "" if group.shared else owner.get(number.element, number.element)
                by_element.setdefault(element, np.zeros(len(twin.table.numbers)))[index] = power
        if not by_element:
            raise ConfigError(f"tuning: the grey box has no number of the group '{kind}'; leave it out of groups")
        for element, powers in by_element.items():
            labels.append(f"{element}.{kind}".lstrip("."))
            columns.append(powers)
            deviations.append(group.deviation)
            warmth.append(group.per_kelvin)
    return tuple(labels), np.stack(columns, axis=1), np.array(deviations), np.array(warmth)


class AdaptiveTwin:
    """A grey box that follows one machine, tick by tick.

    Args:
        twin: the grey box of the machine as it was.
        spec: settings of the adaptation.

    Attributes:
        labels: labels of the groups.
        moves: power of each group's factor in each parameter ``(number, group)``.
        deviation: prior standard deviation of the factors' logarithms ``(group,)``.
        warmth: change of the factors' logarithms per kelvin of oil temperature ``(group,)``.
        logs: logarithms of the groups' factors without the part `by_oil` ``(group,)``; 0 for unchanged parameters.
        by_oil: factor of the oil temperature for each group ``(group,)``.
        learn: whether the factors are adapted; False keeps them constant.
        learned: number of segments used for adaptation.

    Raises:
        ConfigError: a twin that is no grey box, or a group that it has no number of.
    """

    def __init__(self, twin: Twin, spec: TunedSpec | None = None) -> None:
        if not isinstance(twin, GreyTwin):
            raise ConfigError(
                f"a twin of class {type(twin).__name__} came; only a grey box has dead bands and gains that can "
                "follow the machine: train one with --set twin.kind=greybox"
            )
        self.twin, self.spec = twin, spec or TunedSpec()
        self._speeds = np.arange(len(twin.channels.velocities))
        self.labels, self.moves, self.deviation, self.warmth = group_matrix(twin, self.spec.groups)
        self._floor = (LEAST * np.asarray(twin.scales.answer_width[self._speeds], np.float64)) ** 2
        self.learn = True
        self.reset()

    def reset(self) -> None:
        """Forget the machine and all that was learned."""
        self.logs, self._prior = np.zeros(len(self.labels)), np.diag(self.deviation**2)
        self.by_oil = np.zeros(len(self.labels))
        self._covariance, self.learned = self._prior.copy(), 0
        self._square, self._judged = np.zeros(len(self._speeds)), 0
        self.interrupt()

    def interrupt(self) -> None:
        """Report missing samples: the observer restarts at the next sample; the adaptation stays."""
        self._renew(np.zeros(len(self._speeds)))
        self._state: TwinState | None = None
        self._commands: list[Array] = []
        self._measured: list[Array] = []
        self._begin: tuple[TwinState, Array, Doubles] | None = None
        self._now: tuple[Array, TwinState, Array] | None = None
        self._ticks = 0

    def _renew(self, forces: Doubles) -> None:
        self._runner = self._apply_factors(self.logs).runner()
        self._load = DisturbanceObserver(self._runner, self._speeds, self.spec.load_share)
        self._runner.resistance = forces.copy()

    def _apply_factors(self, logs: Doubles) -> GreyTwin:
        return self.twin.with_parameters(self.twin.numbers * np.exp(self.moves @ (self.by_oil + logs)))

    @property
    def factors(self) -> dict[str, float]:
        """Return the factor of each group relative to the original machine."""
        return dict(zip(self.labels, np.exp(self.by_oil + self.logs).tolist(), strict=True))

    def step(self, command: Array, measured: Array, oil_c: float = math.nan) -> None:
        """Process one sample.

        Args:
            command: commands, shape ``(command,)``. A missing command interrupts the segment, because the motion is
                then unknown.
            measured: ``(output,)``, NaN where a sensor is missing: that port runs free.
            oil_c: oil temperature (degC); NaN or an implausible value counts as not measured.
        """
        self._warm(oil_c)
        if not np.isfinite(command).all():
            self.interrupt()
            return
        if self._state is None:
            if not (np.isfinite(measured).all() and self.twin.is_within_stops(measured[None])[0]):
                return
            self._state = dict(self.twin.initial_state(command[None], measured[None]))
        self._take(measured)
        self._load.update(measured[self._speeds].astype(np.float64))
        row = self._port(self._state, measured)
        self._now = (command, self._state, row)
        self._ticks += 1
        if self._begin is None and self._ticks > self.twin.prefix_ticks:
            self._begin = (self._state, row, np.array(self._runner.resistance))
            self._commands, self._measured = [], []
        if self._begin is not None:
            self._commands.append(command)
        after = self._runner.step(command, self._state, row)
        if not np.isfinite(after["answer"]).all():
            # Equations that have come apart would stay so: a port that reads a difference to NaN is free.
            self.interrupt()
            return
        self._load.expect(command, row, self._state, after)
        self._state = after

    def forecast(self, ticks: int) -> Doubles | None:
        """Return velocities `ticks` samples ahead with the command held ``(velocity,)``; None at the start."""
        if self._now is None or self._ticks <= self.twin.prefix_ticks:
            return None
        command, state, row = self._now
        commands, first = np.repeat(command[None, None], ticks, axis=1), np.zeros(1, np.int64)
        return np.asarray(self._runner.branches(commands, state, row, first)[0, -1, self._speeds])

    def _warm(self, oil_c: float) -> None:
        """Adjust the parameters to the oil temperature."""
        apart = oil_c - self.spec.oil_c
        if not (abs(apart) <= 2.0 * HOTTEST_C and abs(oil_c) <= HOTTEST_C):
            return
        logs = self.warmth * apart
        if (np.abs(logs - self.by_oil) > WARMER).any():
            self.by_oil = logs
            self._renew(np.array(self._runner.resistance))

    def _port(self, state: TwinState, measured: Array) -> Array:
        own = np.asarray(state["answer"][0], np.float32)
        # Without a measurement the difference is NaN, which marks a free port.
        return np.asarray(own + np.float32(self.spec.gain) * (measured - own), dtype=np.float32)

    def _take(self, measured: Array) -> None:
        """Store a sample of the segment, and learn at the end of the segment."""
        if self._begin is None or not self._commands:
            return
        self._measured.append(measured[self._speeds])
        if len(self._commands) < self.spec.learn_ticks:
            return
        truth = np.array(self._measured, np.float64)
        if self.learn and np.isfinite(truth).all() and (np.abs(truth) > REST).any():
            self._learn(truth)
        self._begin = None

    def _errors(self, truth: Doubles, logs: Doubles) -> Doubles:
        """Return the errors of the present segment with these factors, SI units ``(tick, velocity)``."""
        if self._begin is None:
            raise ValueError("no stretch has begun")
        state, row, forces = self._begin
        runner = self._apply_factors(logs).runner()
        runner.resistance = forces
        commands = np.array(self._commands, np.float32)[None]
        answers = runner.branches(commands, state, row, np.zeros(1, np.int64))[0][:, self._speeds]
        return np.asarray(truth - answers, dtype=np.float64)

    def _learn(self, truth: Doubles) -> None:
        error = self._errors(truth, self.logs)
        grown = np.eye(len(self.labels)) * STEP
        slopes = np.stack([error - self._errors(truth, self.logs + one) for one in grown], axis=-1) / STEP
        if not (np.isfinite(slopes).all() and np.isfinite(error).all()):
            return
        unit = self._unit(error)
        count, clipped = len(truth), np.clip(error / unit, -CLIP, CLIP).ravel()
        slopes = (slopes / unit[:, None]).reshape(len(clipped), -1)
        posterior = np.linalg.inv(np.linalg.inv(self._covariance) + slopes.T @ slopes / count)
        keep = math.exp(-self.spec.learn_ticks / (self.spec.forgetting_s * self.twin.channels.rate_hz))
        most = BOUND * self.deviation
        self.logs = np.clip(keep * (self.logs + posterior @ (slopes.T @ clipped) / count), -most, most)
        # Its symmetric part, so that rounding of thousands of inversions does not add up.
        self._covariance = keep**2 * 0.5 * (posterior + posterior.T) + (1.0 - keep**2) * self._prior
        self.learned += 1
        self._renew(np.array(self._runner.resistance))

    def _unit(self, error: Doubles) -> Doubles:
        """Return the recent error level ``(velocity,)`` including this segment, SI units; always positive."""
        self._judged = min(self._judged + 1, LATELY)
        self._square = self._square + ((error**2).mean(axis=0) - self._square) / self._judged
        return np.asarray(np.sqrt(np.maximum(self._square, self._floor)))
