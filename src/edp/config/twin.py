"""Settings of a twin: conversion from TOML to validated objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import tomli_w

from edp.data.frozen import SPLITS
from edp.data.splits import ByRecording, SplitSpec
from edp.data.twin_channels import TwinChannelSettings
from edp.errors import ConfigError, closest
from edp.evaluation.free_run import FreeRunJudgeSpec
from edp.networks.twin import TWINS, TwinSpec
from edp.networks.twin.grey.ground import GROUNDS
from edp.networks.twin.model_selection import KINDS, AutoTwin
from edp.settings.tree import SettingsTree
from edp.training.free_run import FreeRunSpec
from edp.training.optimizers import OPTIMIZERS

TWIN_SETTINGS = SettingsTree(
    {"twin": KINDS, "split": SPLITS, "optimizer": OPTIMIZERS},
    {"twin": "auto", "split": "recordings", "optimizer": "soap"},
)


@dataclass(frozen=True, kw_only=True)
class TwinExperiment:
    """All settings of a twin and its evaluation.

    Attributes:
        channels: commands and outputs.
        split: division of the recordings.
        twin: the formulation, or the choice among several.
        training: settings of a training on free runs.
        evaluation: settings of the evaluation.
        ground: law of the ground that a grey box of free air learns from recordings in soil; empty: none.
    """

    channels: TwinChannelSettings = field(default_factory=TwinChannelSettings)
    split: SplitSpec = field(default_factory=ByRecording)
    twin: TwinSpec | AutoTwin = field(default_factory=AutoTwin)
    training: FreeRunSpec = field(default_factory=FreeRunSpec)
    evaluation: FreeRunJudgeSpec = field(default_factory=FreeRunJudgeSpec)
    ground: str = ""

    def __post_init__(self) -> None:
        for name in self.evaluation.baselines:
            try:
                _ = TWINS[name]
            except ConfigError as error:
                raise ConfigError(f"evaluation.baselines: {error}") from None
        if self.ground and self.ground not in GROUNDS:
            raise ConfigError(
                f"ground = '{self.ground[:80]}' is unknown{closest(self.ground, GROUNDS)}; leave it out for free air"
            )


def trains_several(experiment: TwinExperiment) -> bool:
    """Return whether several models are trained: the candidates of a choice, or networks that are averaged."""
    return has_choice(experiment) or getattr(experiment.twin, "members", 1) > 1


def load_twin_experiment(path: str | Path | None = None, overrides: Sequence[str] = ()) -> TwinExperiment:
    """Load settings from a TOML file, changed by ``key.path=value`` overrides, on top of the defaults.

    Raises:
        ConfigError: names every unknown key, wrong type and impossible value at once.
    """
    return TWIN_SETTINGS.load(TwinExperiment, path, overrides, "of a twin")


def limit_processor_time(experiment: TwinExperiment, minutes: float) -> TwinExperiment:
    """Return the settings with a bound on the processor time of an automatic choice; return other settings unchanged.

    Raises:
        ConfigError: the bound is out of range.
    """
    if not isinstance(experiment.twin, AutoTwin):
        return experiment
    return replace(experiment, twin=replace(experiment.twin, time_budget_min=minutes))


def has_choice(experiment: TwinExperiment) -> bool:
    """Return whether settings leave the formulation to a choice."""
    return isinstance(experiment.twin, AutoTwin)


def twin_toml(experiment: TwinExperiment) -> str:
    """Return the complete settings as TOML, including defaults, for the run folder."""
    return tomli_w.dumps(TWIN_SETTINGS.to_dict(experiment))
