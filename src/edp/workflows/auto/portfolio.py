"""Training the portfolio: all candidates, after a short trial of the one that would take most of the budget."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from edp.config.experiment import Experiment
from edp.data.prepared import Prepared
from edp.errors import ConfigError
from edp.progress import SILENT, Progress
from edp.workflows.auto.candidates import CANDIDATES, Amount, RecurrentTrial
from edp.workflows.auto.promise import blocks_of, choose
from edp.workflows.auto.settings import AutoSettings
from edp.workflows.auto.train_candidates import CandidateTraining, TrainedCandidate, train_all

LINEAR, COMMITTEE, RECURRENT = "linear", "committee", "recurrent"
TRIAL_FOLDER = "trial"
MARGIN = 1.25
"""Error of a trial over that of the linear model up to which the long training is worth its time: see decision 99."""
Outcomes = dict[str, TrainedCandidate | str]


@dataclass(frozen=True)
class Trainer:
    """How candidates are trained, and who is told.

    Attributes:
        workers: processes that train side by side; 0 for one a core.
        progress: receiver of the progress; its units are models.
    """

    workers: int = 1
    progress: Progress = SILENT

    def train(self, jobs: Sequence[CandidateTraining], done: int = 0, total: int = 0) -> Outcomes:
        """By name; `done` others of `total` came before."""
        trained = train_all(jobs, self.workers, self.progress, done, total)
        return {job.name: one for job, one in zip(jobs, trained, strict=True)}


@dataclass(frozen=True, eq=False)
class TrainedPortfolio:
    """Every candidate, trained.

    Attributes:
        outcomes: by name, the simplest first; a training that diverged is its message.
        amount: how the budget was divided in the end.
        notes: sentences for a person.
    """

    outcomes: Outcomes
    amount: Amount
    notes: list[str] = field(default_factory=list)


def train_portfolio(
    settings: AutoSettings, data: Prepared, amount: Amount, folder: Path, trainer: Trainer
) -> TrainedPortfolio:
    """Train every candidate that suits the data.

    Where a recurrent network is among them it first trains for a share of its time. Unless it comes near the linear
    model in that, the committee gets more of the budget, and the trial stands for the network.

    Args:
        settings: task, budget, which candidates.
        data: prepared series.
        amount: what there is to learn from.
        folder: of the run; checkpoints lie in it.
        trainer: how.

    Raises:
        ConfigError: no candidate suits the data.
        EdpError: see `train_all`.
    """
    experiments = _experiments(settings, amount)
    if amount.foundation is not None or not {LINEAR, COMMITTEE, RECURRENT} <= experiments.keys():
        return TrainedPortfolio(trainer.train(_jobs(experiments, data, amount, folder)), amount)
    amount = replace(amount, trial=RecurrentTrial.RUNNING)
    experiments = _experiments(settings, amount)
    linear, trial = _jobs({name: experiments[name] for name in (LINEAR, RECURRENT)}, data, amount, folder)
    trial = replace(trial, folder=folder / "candidates" / TRIAL_FOLDER, trial=True)
    first = trainer.train([linear, trial], total=len(experiments))
    ratio = _over_linear(first)
    passed = ratio is not None and ratio <= MARGIN
    amount = replace(amount, trial=RecurrentTrial.PASSED if passed else RecurrentTrial.FAILED)
    experiments = _experiments(settings, amount)
    rest = {name: one for name, one in experiments.items() if name != LINEAR and (passed or name != RECURRENT)}
    second = trainer.train(_jobs(rest, data, amount, folder), done=len(first), total=len(first) + len(rest))
    outcomes = first | second
    return TrainedPortfolio({name: outcomes[name] for name in experiments}, amount, [] if passed else [_note(ratio)])


def _over_linear(outcomes: Mapping[str, TrainedCandidate | str]) -> float | None:
    """Error of the trial over that of the linear model, as candidates are compared; None where one diverged."""
    promises = {name: one.promise for name, one in outcomes.items() if isinstance(one, TrainedCandidate)}
    if len(promises) < len(outcomes):
        return None
    excess = choose(promises).excess
    return math.exp(excess[RECURRENT] - excess[LINEAR])


def _note(ratio: float | None) -> str:
    how = "diverged" if ratio is None else f"had {ratio:.2f} times the linear model's error on left-out data"
    return f"The recurrent network {how} in a short trial, so that it was not trained further: trees got its time."


def _experiments(settings: AutoSettings, amount: Amount) -> dict[str, Experiment]:
    """The candidates that suit the data, the simplest first."""
    names = settings.auto.candidates or tuple(CANDIDATES)
    chosen = [name for name in CANDIDATES if name in names]
    _ = [CANDIDATES[name] for name in names]  # an unknown name is answered with the closest
    tables = {name: CANDIDATES[name].tables(amount) for name in chosen}
    experiments = {name: settings.experiment(table) for name, table in tables.items() if table is not None}
    if not experiments:
        raise ConfigError(
            f"auto.candidates = {list(names)}: none of them suits {amount.rows:,} ticks of training; add 'linear' or "
            "'committee'"
        )
    return experiments


def _jobs(
    experiments: Mapping[str, Experiment], data: Prepared, amount: Amount, folder: Path
) -> list[CandidateTraining]:
    """The trainings of the candidates, judged on the same blocks."""
    blocks, judged = blocks_of(data, amount.window)
    begun = {"foundation": amount.foundation}
    return [
        CandidateTraining(name, experiment, data, folder / "candidates" / name, blocks, judged, begun.get(name))
        for name, experiment in experiments.items()
    ]
