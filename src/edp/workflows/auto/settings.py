"""Settings of the automatic preset: everything of an experiment but the network and its training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from edp.config.experiment import (
    AUTO,
    SETTINGS,
    Experiment,
    TaskSettings,
    build,
    preset_table,
    read_layers,
)
from edp.data.splits import ByRecording, SplitSpec
from edp.errors import ConfigError
from edp.evaluation.judge import JudgeSpec
from edp.networks.predictor import ModelSpec
from edp.settings.bounds import MAX_THREADS, MIN_MINUTES, SEED, check_bounds, integer, span
from edp.settings.tree import merged, override, read_toml
from edp.training.spec import TrainingSpec

MAX_MINUTES = 10_000.0
CHOSEN = ("model", "training")
"""Tables of an experiment that the portfolio fills in."""


@dataclass(frozen=True, kw_only=True)
class Portfolio:
    """The table ``[auto]``.

    Attributes:
        time_budget_min: processor time to spend on training; sizes of networks and lengths of trainings follow from
            it, so that equal settings and data give equal results on every machine.
        candidates: names of registered candidates, the simplest first; none takes all of them.
        foundation: run folder or bundle of a pretrained network, which is trained on as one more candidate; empty for
            none.
        seed: seed of all random choices.
        threads: CPU threads of a training; another count gives other bits.
    """

    time_budget_min: float = 5.0
    candidates: tuple[str, ...] = ()
    foundation: str = ""
    seed: int = 0
    threads: int = 1

    def __post_init__(self) -> None:
        check_bounds(
            "auto", self, time_budget_min=span(MIN_MINUTES, MAX_MINUTES), seed=SEED, threads=integer(0, MAX_THREADS)
        )
        if self.candidates and ("foundation" in self.candidates) != bool(self.foundation):
            raise ConfigError(
                f"auto.candidates = {list(self.candidates)} and auto.foundation = '{self.foundation}': the candidate "
                "'foundation' and the run that it begins with go together; give both or neither"
            )


@dataclass(frozen=True, kw_only=True)
class AutoSettings:
    """Settings of an automatic training and its evaluation."""

    task: TaskSettings = field(default_factory=TaskSettings)
    split: SplitSpec = field(default_factory=ByRecording)
    auto: Portfolio = field(default_factory=Portfolio)
    evaluation: JudgeSpec = field(default_factory=JudgeSpec)

    def experiment(self, model: ModelSpec, training: TrainingSpec) -> Experiment:
        """Return the experiment of a candidate."""
        return Experiment(task=self.task, split=self.split, model=model, training=training, evaluation=self.evaluation)


def usual_preset(path: str | Path | None = None, overrides: Sequence[str] = ()) -> str:
    """Return the default preset: ``auto``, or ``standard`` with settings of the network or its training.

    Raises:
        ConfigError: a file or an override that cannot be read.
    """
    tables = [{} if path is None else read_toml(path), *map(override, overrides)]
    return "standard" if any(part in table for table in tables for part in CHOSEN) else AUTO


def load_auto(path: str | Path | None = None, overrides: Sequence[str] = ()) -> AutoSettings:
    """Load settings from the preset ``auto``, changed by a TOML file and by ``key.path=value`` overrides.

    Raises:
        ConfigError: names every unknown key, wrong type and impossible value at once; settings of the network or of
            its training, which the portfolio chooses.
    """
    table = preset_table("auto")
    where = "preset 'auto'"
    if path is not None:
        where = f"'{path}' with preset 'auto'"
    for layer in read_layers(path, overrides):
        table = merged(table, SETTINGS.renamed(AutoSettings, layer))
    return auto_settings(table, where)


def auto_settings(table: Mapping[str, object], where: str) -> AutoSettings:
    """Return the settings of a table.

    Raises:
        ConfigError: see `load_auto`.
    """
    present = [part for part in CHOSEN if part in table]
    if present:
        raise ConfigError(
            f"{where}: [{'], ['.join(present)}] came with the preset 'auto', which chooses the network and its "
            "training; take them out (the seed is auto.seed), or name the preset that they change, for example "
            "--preset standard"
        )
    return build(AutoSettings, table, where)
