"""Settings of closed loops: conversion from TOML to validated objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import tomli_w

from edp.control.controllers import CONTROLLERS, ControllerSpec
from edp.control.controllers.pi import ProportionalIntegral
from edp.control.tasks import TASKS, TaskSpec
from edp.control.tasks.grade import Grade
from edp.errors import ConfigError
from edp.settings.bounds import MAX_SEED, above, check_bounds, integer, span
from edp.settings.tree import SettingsTree
from edp.wording import setting_text, typed

CONTROL_SETTINGS = SettingsTree(
    {"task": TASKS, "controller": CONTROLLERS}, {"task": "grade", "controller": "pi"}, what="settings"
)
MOST_LOOPS = 10_000


@dataclass(frozen=True, kw_only=True)
class ControlExperiment:
    """Everything that settles closed loops.

    Attributes:
        task: task to follow.
        controller: controller of the levers.
        machine: name of a machine, or path of a machine file.
        loops: number of loops, each of a seed of its own.
        seed: seed of the first loop; the following loops have the following seeds.
        rate_hz: ticks per second.
        deadline_ms: time of the clock after which an answer of the controller counts as missing, and levers go towards
            neutral; 0: none. With one, loops depend on what else the computer does.
    """

    task: TaskSpec = field(default_factory=Grade)
    controller: ControllerSpec = field(default_factory=ProportionalIntegral)
    machine: str = "M22"
    loops: int = 6
    seed: int = 0
    rate_hz: float = 100.0
    deadline_ms: float = 0.0

    def __post_init__(self) -> None:
        # The last loop's seed must be one, too.
        check_bounds(
            "control",
            self,
            loops=integer(1, MOST_LOOPS),
            seed=integer(0, MAX_SEED - MOST_LOOPS),
            rate_hz=above(0.0, 1000.0),
            deadline_ms=span(0.0, 1e6),
        )
        if self.deadline_ms > 1e3 / self.rate_hz:
            raise ConfigError(
                f"control: deadline_ms = {setting_text(self.deadline_ms)}, but a tick has "
                f"{typed(1e3 / self.rate_hz)} ms at rate_hz = "
                f"{typed(self.rate_hz)}; give a deadline within it, or 0 for none"
            )


def load_control_experiment(
    path: str | Path | None = None, overrides: Sequence[str] = (), options: Mapping[str, object] | None = None
) -> ControlExperiment:
    """Load settings from a TOML file, changed by command options and ``key.path=value`` overrides.

    Args:
        path: settings file.
        overrides: each ``key.path=value``; they go before options.
        options: plain values of options that were given, by key.

    Raises:
        ConfigError: names every unknown key, wrong type and impossible value at once.
    """
    return CONTROL_SETTINGS.load(ControlExperiment, path, overrides, "of closed loops", options)


def control_toml(experiment: ControlExperiment) -> str:
    """Return the complete settings as TOML, including defaults, for the run folder."""
    return tomli_w.dumps(CONTROL_SETTINGS.to_dict(experiment))
