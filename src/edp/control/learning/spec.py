"""Settings of a task environment: reference, plant, observation, action and reward, checked before the first step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from edp.control.controllers import CONTROLLERS, ControllerSpec
from edp.control.learning.reward import RewardWeights
from edp.control.plant import STROKES, VELOCITIES
from edp.control.tasks import TASKS, TaskSpec
from edp.errors import ConfigError, closest
from edp.networks.twin import Twin
from edp.settings.bounds import MAX_SEED, above, check_bounds, integer, span
from edp.signals import TABLE_A1, Kind
from edp.sim.environment import EnvironmentSpec
from edp.wording import setting_text, typed

PRESSURES = tuple(name for name, channel in TABLE_A1.items() if channel.kind is Kind.PRESSURE)
OBSERVED = (*VELOCITIES, *STROKES, *PRESSURES)
"""Channels that both the simulator and a twin of a typical log provide."""
FIRST_SEED = 1_000_000
"""Smallest seed of the references that an environment draws. The references for evaluation and tuning start at 0."""
SIMULATOR = ("step_s", "sensor_noise", "hand", "loop_latency", "lost_frames", "sensors")
"""Settings of `EnvironmentSpec` that the user may choose. The task determines the machine, the soil and the start."""
MOST_TICKS = 1_000_000


@dataclass(frozen=True)
class LearningSpec:
    """One task as an environment.

    Attributes:
        task: name in `TASKS`.
        options: options of the task, by name; nested tables such as ``limits`` as objects.
        machine: name or file of the machine.
        plant: run folder of a twin, or an FMU (`.fmu`), in place of the simulator; or a twin itself.
        trust_fmu: an FMU is native code, which runs with your rights; it is not loaded without this.
        rate_hz: sampling rate in Hz.
        duration_s: longest episode; a longer reference is cut off there.
        hold: number of samples for which an action is held.
        observed: measured channels in the observation; strokes are always among what is read.
        preview_s: lead up to which the stroke velocities of the reference are observed, s.
        past_s: time back to which past levers are observed, in addition to the last ones, s.
        base: controller that the action corrects, such as ``pi``; empty: the action is the levers.
        gains: options of that controller.
        authority: levers of an action of one, with a base.
        reward: weights.
        lost_m: position error at which the episode terminates.
        seeds: lowest and highest seed of references that are drawn where a reset gives none.
        simulator: further settings of `EnvironmentSpec`, of `SIMULATOR` only.

    Raises:
        ConfigError: a value is out of range, or a task, controller, option or setting is unknown.
    """

    task: str = "grade"
    options: Mapping[str, Any] = field(default_factory=dict)
    machine: str = "M22"
    plant: str | Path | Twin | None = None
    trust_fmu: bool = False
    rate_hz: float = 100.0
    duration_s: float = 40.0
    hold: int = 1
    observed: tuple[str, ...] = OBSERVED
    preview_s: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.5)
    past_s: tuple[float, ...] = (0.05, 0.1)
    base: str = ""
    gains: Mapping[str, float] = field(default_factory=dict)
    authority: float = 0.2
    reward: RewardWeights = field(default_factory=RewardWeights)
    lost_m: float = 0.5
    seeds: tuple[int, int] = (FIRST_SEED, MAX_SEED)
    simulator: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key in ("observed", "preview_s", "past_s", "seeds"):
            object.__setattr__(self, key, tuple(getattr(self, key)))
        check_bounds(
            "task environment",
            self,
            rate_hz=above(0.0, 1000.0),
            duration_s=above(0.0, 86_400.0),
            hold=integer(1, 1000),
            preview_s=span(0.0, 10.0),
            past_s=span(0.0, 10.0),
            authority=above(0.0, 2.0),
            lost_m=above(0.0, 100.0),
            seeds=integer(0, MAX_SEED),
        )
        if len(self.seeds) != 2 or self.seeds[0] > self.seeds[1]:
            raise ConfigError(f"task environment: seeds = {list(self.seeds)}; the lowest and the highest must hold")
        if not self.ticks > self.hold or self.ticks > MOST_TICKS:
            raise ConfigError(
                f"task environment: duration_s = {setting_text(self.duration_s)} at {typed(self.rate_hz)} Hz is "
                f"{self.ticks} ticks; "
                f"more than one action ({self.hold} ticks) and at most {MOST_TICKS} must hold"
            )
        for name in self.simulator:
            if name not in SIMULATOR:
                raise ConfigError(f"task environment: simulator setting '{name}' is unknown{closest(name, SIMULATOR)}")
        # For their refusals only.
        self.task_spec, self.controller, self.plant_settings  # noqa: B018

    @property
    def ticks(self) -> int:
        """Most ticks of an episode."""
        return round(self.duration_s * self.rate_hz)

    @property
    def task_spec(self) -> TaskSpec:
        """The task with its options.

        Raises:
            ConfigError: an option is unknown or out of range.
        """
        kind = TASKS[self.task]
        _check_names(f"task '{self.task}'", self.options, kind)
        return kind(**self.options)

    @property
    def controller(self) -> ControllerSpec | None:
        """The controller that actions correct; None where they are the levers.

        Raises:
            ConfigError: a gain is unknown or out of range.
        """
        if not self.base:
            if self.gains:
                raise ConfigError(f"task environment: gains {sorted(self.gains)} without a base; name a controller")
            return None
        kind = CONTROLLERS[self.base]
        _check_names(f"controller '{self.base}'", self.gains, kind)
        spec: ControllerSpec = kind(**self.gains)
        needed = [name for name in spec.needs if name != "valve_map"]
        if needed:
            raise ConfigError(
                f"task environment: controller '{self.base}' needs a {needed[0]}; a base has a valve map alone: give "
                "pi, or leave base out"
            )
        return spec

    @property
    def plant_settings(self) -> EnvironmentSpec:
        """Return the settings of the simulator with two extra samples per episode: for the reset and in reserve."""
        # Soil comes with each reset.
        longest = (self.ticks + self.hold + 2) / self.rate_hz
        return EnvironmentSpec(machine=self.machine, duration_s=longest, rate_hz=self.rate_hz, **self.simulator)


def learning_spec(settings: LearningSpec | None, changes: Mapping[str, Any]) -> LearningSpec:
    """Return the settings (default if None) with the changes applied.

    Raises:
        ConfigError: a change names no setting (the closest is offered), or is out of range.
    """
    _check_names("task environment", changes, LearningSpec)
    return replace(settings or LearningSpec(), **changes)


def _check_names(what: str, values: Mapping[str, Any], kind: type) -> None:
    names = [entry.name for entry in fields(kind)]
    for name in values:
        if name not in names:
            raise ConfigError(f"{what}: option '{name}' is unknown{closest(str(name), names)}")
