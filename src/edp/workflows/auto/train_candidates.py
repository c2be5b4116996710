"""Training of the candidates in sequence or in parallel, after a short trial of the longest training."""

from __future__ import annotations

import hashlib
import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from edp.config.experiment import Experiment, experiment_toml, plain_tree
from edp.data.prepared import Prepared
from edp.errors import ConfigError, EdpError
from edp.jobs import IN_PROCESS, Workers
from edp.jobs.packing import pack, unpack
from edp.jobs.workers import UNITS, UnitResult, WorkUnit, forget_units
from edp.progress import SILENT, Progress
from edp.storage import make_folder, read_object, write_json
from edp.storage.ledger import TrainingIdentity, WithState
from edp.storage.paths import entries_of, full_path, is_file_at, is_folder_at
from edp.storage.reading import Table
from edp.storage.runs import KeyedRun, Run, run_key
from edp.training import Diverged, Fitted, TrainingProgress, load_bundle, make_bundle, save_bundle
from edp.training.bagging.fit import fit_bagged
from edp.training.blas import one_blas_thread
from edp.training.fit import fit
from edp.training.progress_steps import training_steps
from edp.workflows.auto.candidates import CANDIDATES, Amount, Foundation, RecurrentTrial
from edp.workflows.auto.promise import (
    Block,
    Promise,
    blocks_of,
    choose,
    promise_of,
    promise_of_validation,
    standard_truth,
)
from edp.workflows.auto.settings import AutoSettings

NOTE = "progress.json"
"""How far a training in another process is, in its folder."""
LINEAR, COMMITTEE, RECURRENT = "linear", "committee", "recurrent"
TRIAL_FOLDER, FITTED, DIVERGED = "trial", "fitted", "diverged"
MARGIN = 1.25
"""Error of a trial over that of the linear model up to which the long training is worth its time: see decision 99."""
OnEvent = Callable[[TrainingProgress], None]


@dataclass(frozen=True, eq=False)
class CandidateTraining:
    """The training of one candidate, ready for another process.

    Attributes:
        name: name of the candidate.
        experiment: its settings.
        data: prepared series.
        folder: folder of its checkpoints.
        blocks: blocks for the evaluation; the last `judged` of them belong to the validation part.
        judged: number of blocks of the validation part.
        foundation: a network to begin with; None where it begins at random.
        trial: a short training that tells whether a long one is worth its time.
    """

    name: str
    experiment: Experiment
    data: Prepared
    folder: Path
    blocks: Sequence[Block]
    judged: int
    foundation: Foundation | None = None
    trial: bool = False

    @property
    def label(self) -> str:
        """Return its name in sentences."""
        return CANDIDATES[self.name].label + (", a short trial" if self.trial else "")

    @property
    def on_folds(self) -> bool:
        """Test whether it is trained with cross-validation folds.

        Networks trained by gradient descent on chunks are not.
        """
        return self.experiment.training.ensemble is not None


@dataclass(frozen=True, eq=False)
class TrainedCandidate:
    """Result of a candidate's training.

    Attributes:
        experiment: the settings.
        fitted: the network.
        promise: its error on what it left out.
    """

    experiment: Experiment
    fitted: Fitted
    promise: Promise


@one_blas_thread()
def train_candidate(job: CandidateTraining, on_event: OnEvent | None = None) -> TrainedCandidate | str:
    """Train one candidate; the same in any process. A training that diverged gives its message.

    Raises:
        EdpError: data or settings that cannot be used.
    """
    try:
        return _train_on_folds(job, on_event) if job.on_folds else _train_by_gradient(job, on_event)
    except Diverged as end:
        return str(end)


def _train_on_folds(job: CandidateTraining, on_event: OnEvent | None) -> TrainedCandidate:
    bagged = fit_bagged(job.data, job.experiment.model, job.experiment.training, on_event)
    truth = standard_truth(bagged.fitted.predictor, job.data)
    promise = promise_of(bagged.predict_all(truth), truth, job.blocks)
    return TrainedCandidate(job.experiment, bagged.fitted, promise)


def _train_by_gradient(job: CandidateTraining, on_event: OnEvent | None) -> TrainedCandidate:
    experiment, begun = job.experiment, {}
    if job.foundation is not None:
        begun = {"foundation": job.foundation.facts}
    settings = {part: values for part, values in plain_tree(experiment).items() if part != "evaluation"}
    key = run_key(settings | begun, job.data.digest)
    with Run.create(job.folder, "network", key, experiment_toml(experiment)) as run:
        strategy = None if job.foundation is None else job.foundation.strategy()
        fitted = fit(job.data, experiment.model, experiment.training, KeyedRun(run, key), on_event, strategy)
    promise = promise_of_validation(fitted.predictor, job.data, job.blocks, job.judged)
    return TrainedCandidate(experiment, fitted, promise)


def train_all(
    jobs: Sequence[CandidateTraining],
    workers: Workers,
    run: Path,
    progress: Progress = SILENT,
    done: int = 0,
    total: int = 0,
) -> Iterator[TrainedCandidate | str]:
    """Train candidates and yield them in order; the same bits with any number of processes.

    Args:
        jobs: the trainings, the shortest first.
        workers: who trains; nodes see the run folder under the same path.
        run: run folder; what is trained in it is read.
        progress: receiver of the progress; its units are models.
        done: number of models trained before these.
        total: number of models with those before and after these; 0 for these alone.

    Raises:
        EdpError: see `train_candidate`, or a process was killed again and again.
    """
    # Trainings on folds alone take seconds where a process takes as long to start.
    if not workers.are_alone and not all(job.on_folds for job in jobs):
        display = _Display(jobs, progress)
        # The longest first, or it would wait for the others and end alone.
        for _ in workers.map([_unit(job) for job in jobs[::-1]], folder=run / UNITS, waiting=display.look):
            display.look()
        for job in jobs:
            (job.folder / NOTE).unlink(missing_ok=True)
        progress = SILENT
    models = progress.stage("model", total or len(jobs))
    for number, job in enumerate(jobs, start=done):
        models.step(number)
        models.note(job.label)
        if job.on_folds:
            result = next(IN_PROCESS.map_in_order([_unit(job)], folder=run / UNITS))
            yield _read_trained(job, result)
        else:
            yield train_candidate(job, training_steps(models))


@dataclass(frozen=True)
class _FoldResult:
    """Result of a training on folds, next to the bundle in its folder."""

    promise: Promise
    history: list[Table]
    seconds: float
    targets_per_s: float


def _unit(job: CandidateTraining) -> WorkUnit:
    """Return a training as a unit of work."""
    placed = replace(job, folder=full_path(job.folder))
    blocks = hashlib.blake2b(repr((list(job.blocks), job.judged)).encode(), digest_size=16).hexdigest()
    arguments = {
        "experiment": plain_tree(job.experiment),
        "trial": job.trial,
        "blocks": blocks,
        "foundation": None if job.foundation is None else job.foundation.facts,
        "folder": str(placed.folder),
    }
    return WorkUnit(f"{__name__}:train_unit", job.label, arguments, job.data.digest, {"job": placed})


def train_unit(identity: TrainingIdentity, where: Mapping[str, CandidateTraining]) -> WithState | dict[str, str]:
    """Train a candidate into its folder, and note there how far the training is."""
    job = where["job"]
    note = make_folder(job.folder) / NOTE

    def tell(event: TrainingProgress) -> None:
        left = {"epoch", "epochs", "update", "updates", "targets_per_s", "seconds_left"}
        write_json(note, {name: value for name, value in vars(event).items() if name in left})

    trained = train_candidate(job, tell)
    if isinstance(trained, str):
        return {DIVERGED: trained}
    if not job.on_folds:
        return {}
    note.unlink(missing_ok=True)
    fitted = trained.fitted
    save_bundle(make_bundle(fitted.predictor, job.data), job.folder / FITTED)
    return WithState({}, pack(_FoldResult(trained.promise, fitted.history, fitted.seconds, fitted.targets_per_s)))


def _read_trained(job: CandidateTraining, result: UnitResult) -> TrainedCandidate | str:
    """Return a candidate trained with cross-validation folds, or the message of a diverged training."""
    if DIVERGED in result.values:
        return str(result.values[DIVERGED])
    stored = unpack(result.content or b"", _FoldResult)
    predictor = load_bundle(job.folder / FITTED).predictor
    fitted = Fitted(predictor, stored.history, stored.seconds, stored.targets_per_s, 0)
    return TrainedCandidate(job.experiment, fitted, stored.promise)


def remove_trained_units(run: Path) -> None:
    """Remove what trainings left for a continued run, once the choice is written."""
    forget_units(run / UNITS)
    for candidate in entries_of(run / "candidates"):
        if is_folder_at(candidate / FITTED):
            shutil.rmtree(candidate, ignore_errors=True)


class _Display:
    """Shows of trainings side by side the one that has the longest to go."""

    def __init__(self, jobs: Sequence[CandidateTraining], progress: Progress) -> None:
        self.jobs, self.progress = jobs, progress
        self.last: TrainingProgress | None = None

    def look(self) -> None:
        """Read the notes, and report new ones."""
        noted = [(job, event) for job in self.jobs if (event := _read_progress(job)) is not None]
        if not noted:
            return
        job, event = max(noted, key=lambda pair: pair[1].seconds_left)
        if event != self.last:
            training_steps(self.progress.stage(job.label))(event)
        self.last = event


def _read_progress(job: CandidateTraining) -> TrainingProgress | None:
    names = ("epoch", "epochs", "update", "updates", "targets_per_s", "seconds_left")
    note = job.folder / NOTE
    if not is_file_at(note):
        return None
    try:
        row = read_object(note, names)
        epoch, epochs, update, updates = (max(1, int(row[name])) for name in names[:4])
        speed, left = float(row["targets_per_s"]), float(row["seconds_left"])
        return TrainingProgress(epoch, epochs, update, updates, speed, left)
    except (EdpError, TypeError, ValueError):
        return None  # a note is for readers: what cannot be read now is read at the next look


@dataclass(frozen=True, eq=False)
class TrainedPortfolio:
    """Every candidate, trained.

    Attributes:
        outcomes: outcomes by name, the simplest first; a diverged training is represented by its message.
        amount: final division of the budget.
        notes: sentences for a person.
    """

    outcomes: dict[str, TrainedCandidate | str]
    amount: Amount
    notes: list[str] = field(default_factory=list)


def train_portfolio(
    settings: AutoSettings,
    data: Prepared,
    amount: Amount,
    folder: Path,
    workers: Workers = IN_PROCESS,
    progress: Progress = SILENT,
) -> TrainedPortfolio:
    """Train every candidate that suits the data.

    A recurrent network first trains for a share of its time. Unless its error comes near that of the linear model, the
    committee gets more of the budget, and the trial stands for the network.

    Args:
        settings: task, budget, which candidates.
        data: prepared series.
        amount: amount of data and time.
        folder: folder of the run, with the checkpoints.
        workers: who trains; nodes see the run folder under the same path.
        progress: receiver of the progress; its units are models.

    Raises:
        ConfigError: no candidate suits the data.
        EdpError: see `train_all`.
    """

    def train(jobs: Sequence[CandidateTraining], done: int = 0, total: int = 0) -> dict[str, TrainedCandidate | str]:
        trained = train_all(jobs, workers, folder, progress, done, total)
        return {job.name: one for job, one in zip(jobs, trained, strict=True)}

    experiments = _experiments(settings, amount)
    if amount.foundation is not None or not {LINEAR, COMMITTEE, RECURRENT} <= experiments.keys():
        return TrainedPortfolio(train(_jobs(experiments, data, amount, folder)), amount)
    amount = replace(amount, trial=RecurrentTrial.RUNNING)
    experiments = _experiments(settings, amount)
    linear, trial = _jobs({name: experiments[name] for name in (LINEAR, RECURRENT)}, data, amount, folder)
    trial = replace(trial, folder=folder / "candidates" / TRIAL_FOLDER, trial=True)
    first = train([linear, trial], total=len(experiments))
    ratio = _compare_with_linear(first)
    passed = ratio is not None and ratio <= MARGIN
    amount = replace(amount, trial=RecurrentTrial.PASSED if passed else RecurrentTrial.FAILED)
    experiments = _experiments(settings, amount)
    rest = {name: one for name, one in experiments.items() if name != LINEAR and (passed or name != RECURRENT)}
    second = train(_jobs(rest, data, amount, folder), done=len(first), total=len(first) + len(rest))
    outcomes = first | second
    notes = []
    if not passed:
        how = "diverged" if ratio is None else f"had {ratio:.2f} times the linear model's error on left-out data"
        notes = [
            f"The recurrent network {how} in a short trial, so that it was not trained further: trees got its time."
        ]
    return TrainedPortfolio({name: outcomes[name] for name in experiments}, amount, notes)


def _compare_with_linear(outcomes: Mapping[str, TrainedCandidate | str]) -> float | None:
    """Return the error of the trial relative to the linear model's, on the comparison data; None if one diverged."""
    promises = {name: one.promise for name, one in outcomes.items() if isinstance(one, TrainedCandidate)}
    if len(promises) < len(outcomes):
        return None
    excess = choose(promises).excess
    return math.exp(excess[RECURRENT] - excess[LINEAR])


def _experiments(settings: AutoSettings, amount: Amount) -> dict[str, Experiment]:
    """Return the settings of the candidates that suit the data, the simplest first.

    Raises:
        ConfigError: an unknown candidate, or no candidate suits the data.
    """
    names = settings.auto.candidates or tuple(CANDIDATES)
    chosen = [name for name in CANDIDATES if name in names]
    _ = [CANDIDATES[name] for name in names]  # an unknown name is answered with the closest
    plans = {name: CANDIDATES[name].plan(amount) for name in chosen}
    experiments = {
        name: settings.experiment(plan.model, plan.training) for name, plan in plans.items() if plan is not None
    }
    if not experiments:
        raise ConfigError(
            f"auto.candidates = {list(names)}: none of them suits {amount.rows:,} ticks of training; add 'linear' or "
            "'committee'"
        )
    return experiments


def _jobs(
    experiments: Mapping[str, Experiment], data: Prepared, amount: Amount, folder: Path
) -> list[CandidateTraining]:
    """Return the trainings of the candidates, which are evaluated on the same blocks."""
    blocks, judged = blocks_of(data, amount.window)
    begun = {"foundation": amount.foundation}
    return [
        CandidateTraining(name, experiment, data, folder / "candidates" / name, blocks, judged, begun.get(name))
        for name, experiment in experiments.items()
    ]
