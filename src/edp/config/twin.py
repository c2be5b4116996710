"""The settings of a twin: TOML in, validated specs out, as those of an experiment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import tomli_w

from edp.data.frozen import SPLITS
from edp.data.splits import ByRecording, SplitSpec
from edp.data.twin_channels import TwinChannelSettings
from edp.errors import ConfigError
from edp.evaluation.free_run import FreeRunJudgeSpec
from edp.networks.twin import TWINS, TwinSpec
from edp.networks.twin.base import PREFIX
from edp.registry import Registry
from edp.settings.bounds import MOST_NAMES, SHARE, check_bounds, check_count
from edp.settings.tree import SettingsTree, Table, merged, override, read_toml
from edp.training.free_run import FreeRunSpec
from edp.training.optimizers import OPTIMIZERS

KINDS: Registry[type] = Registry("twin")
"""Every formulation, and the choice among several of them."""
for _name, _formulation in TWINS.items():
    KINDS.register(_name)(_formulation)
TWIN_SETTINGS = SettingsTree(
    {"twin": KINDS, "split": SPLITS, "optimizer": OPTIMIZERS},
    {"twin": "auto", "split": "recordings", "optimizer": "soap"},
)


@KINDS.register("auto")
@dataclass(frozen=True, kw_only=True)
class AutoTwin:
    """Several formulations are fitted to the training part, and free runs of the validation part choose.

    Attributes:
        candidates: formulations, the simplest first.
        least_gain: share of error by which a candidate must be better than a simpler one.
        prefix_ticks: measured ticks before a free run.

    Raises:
        ConfigError: a value out of range, no candidate, or an unknown one.
    """

    candidates: tuple[str, ...] = ("static", "arx", "n4sid", "recurrent")
    least_gain: float = 0.02
    prefix_ticks: int = 30

    def __post_init__(self) -> None:
        check_bounds("automatic twin", self, least_gain=SHARE, prefix_ticks=PREFIX)
        check_count("automatic twin", "candidates", self.candidates, MOST_NAMES, least=1)
        for name in self.candidates:
            try:
                _ = TWINS[name]
            except ConfigError as error:
                raise ConfigError(f"twin.candidates: {error}") from None
        if len(set(self.candidates)) < len(self.candidates):
            raise ConfigError(f"twin.candidates: {', '.join(self.candidates)}; each once must hold")


@dataclass(frozen=True, kw_only=True)
class TwinExperiment:
    """Everything that settles a twin and its judgement.

    Attributes:
        channels: which channels command, and which it answers.
        split: how recordings are divided.
        twin: the formulation, or the choice among several.
        training: how it is trained, where it is trained on free runs.
        judge: how it is judged.
    """

    channels: TwinChannelSettings = field(default_factory=TwinChannelSettings)
    split: SplitSpec = field(default_factory=ByRecording)
    twin: TwinSpec | AutoTwin = field(default_factory=AutoTwin)
    training: FreeRunSpec = field(default_factory=FreeRunSpec)
    judge: FreeRunJudgeSpec = field(default_factory=FreeRunJudgeSpec)

    def __post_init__(self) -> None:
        for name in self.judge.floors:
            try:
                _ = TWINS[name]
            except ConfigError as error:
                raise ConfigError(f"judge.floors: {error}") from None


def load_twin_experiment(path: str | Path | None = None, overrides: Sequence[str] = ()) -> TwinExperiment:
    """Settings from a TOML file, changed by ``key.path=value`` overrides, over the defaults of the specs.

    Raises:
        ConfigError: names every unknown key, wrong type and impossible value at once.
    """
    table: Table = {} if path is None else read_toml(path)
    for text in overrides:
        table = merged(table, override(text))
    where = "of a twin" if path is None else f"'{path}'"
    return TWIN_SETTINGS.build(TwinExperiment, table, where + (" with --set" if overrides else ""))


def twin_toml(experiment: TwinExperiment) -> str:
    """The whole settings as TOML, defaults included: what a run folder keeps."""
    return tomli_w.dumps(TWIN_SETTINGS.plain(experiment))
