"""Training the candidates of a portfolio, one by one or side by side, with the error that each promises."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from edp.config.experiment import Experiment, experiment_toml, plain_tree
from edp.data.prepared import Prepared
from edp.errors import EdpError, LostError
from edp.progress import SILENT, Progress
from edp.sandbox.helpers import Helpers
from edp.storage import make_folder, read_object, write_json
from edp.storage.paths import is_file_at
from edp.storage.runs import KeyedRun, Run, run_key
from edp.training import Diverged, Fitted, TrainingProgress
from edp.training.bagging.fit import fit_bagged
from edp.training.blas import one_blas_thread
from edp.training.fit import fit
from edp.training.progress_steps import training_steps
from edp.workflows.auto.candidates import CANDIDATES
from edp.workflows.auto.foundation import Foundation
from edp.workflows.auto.promise import Block, Promise, promise_of, promise_of_validation, standard_truth

NOTE = "progress.json"
"""How far a training in another process is, in its folder."""
OnEvent = Callable[[TrainingProgress], None]


@dataclass(frozen=True, eq=False)
class CandidateTraining:
    """The training of one candidate, ready for another process.

    Attributes:
        name: of the candidate.
        experiment: its settings.
        data: prepared series.
        folder: of its checkpoints.
        blocks: on which it is judged; the last `judged` of them are of the validation part.
        judged: how many.
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
        """How sentences call it."""
        return CANDIDATES[self.name].label + (", a short trial" if self.trial else "")

    @property
    def on_folds(self) -> bool:
        """Whether it is trained on folds; the others are networks that learn by gradient, chunk by chunk."""
        return self.experiment.training.bagging is not None


@dataclass(frozen=True, eq=False)
class TrainedCandidate:
    """What a training gives.

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
        return _on_folds(job, on_event) if job.on_folds else _by_gradient(job, on_event)
    except Diverged as end:
        return str(end)


def _on_folds(job: CandidateTraining, on_event: OnEvent | None) -> TrainedCandidate:
    bagged = fit_bagged(job.data, job.experiment.model, job.experiment.training, on_event)
    truth = standard_truth(bagged.fitted.predictor, job.data)
    promise = promise_of(bagged.at_every_tick(truth), truth, job.blocks)
    return TrainedCandidate(job.experiment, bagged.fitted, promise)


def _by_gradient(job: CandidateTraining, on_event: OnEvent | None) -> TrainedCandidate:
    experiment, begun = job.experiment, {}
    if job.foundation is not None:
        begun = {"foundation": job.foundation.facts}
    settings = {part: values for part, values in plain_tree(experiment).items() if part != "judge"}
    key = run_key(settings | begun, job.data.digest)
    with Run.create(job.folder, "network", key, experiment_toml(experiment)) as run:
        strategy = None if job.foundation is None else job.foundation.strategy()
        fitted = fit(job.data, experiment.model, experiment.training, KeyedRun(run, key), on_event, strategy)
    promise = promise_of_validation(fitted.predictor, job.data, job.blocks, job.judged)
    return TrainedCandidate(experiment, fitted, promise)


def train_all(
    jobs: Sequence[CandidateTraining], workers: int, progress: Progress = SILENT, done: int = 0, total: int = 0
) -> Iterator[TrainedCandidate | str]:
    """What each training gives, in order; the same bits with any number of processes.

    Args:
        jobs: the trainings, the shortest first.
        workers: processes; 0 for one a core.
        progress: receiver of the progress; its units are models.
        done: number of models trained before these.
        total: number of models with those before and after these; 0 for these alone.

    Raises:
        EdpError: see `train_candidate`, or a process died.
    """
    count = min(workers or os.cpu_count() or 1, len(jobs))
    # Trainings on folds alone take seconds where a process takes as long to start.
    if count <= 1 or all(job.on_folds for job in jobs):
        models = progress.stage("model", total or len(jobs))
        for number, job in enumerate(jobs, start=done):
            models.step(number)
            models.note(job.label)
            yield train_candidate(job, training_steps(models))
        return
    display = _Display(jobs, progress)
    with Helpers(count, _died) as helpers:
        # The longest first, or it would wait for the others and end alone.
        trained = list(helpers.ordered(_noting, jobs[::-1], display.look))
    for job in jobs:
        (job.folder / NOTE).unlink(missing_ok=True)
        if job.on_folds:
            job.folder.rmdir()
    yield from trained[::-1]


def _noting(job: CandidateTraining) -> TrainedCandidate | str:
    """`train_candidate` in another process, which notes in the folder of the job how far it is."""
    note = make_folder(job.folder) / NOTE

    def tell(event: TrainingProgress) -> None:
        left = {"epoch", "epochs", "update", "updates", "targets_per_s", "seconds_left"}
        write_json(note, {name: value for name, value in vars(event).items() if name in left})

    return train_candidate(job, tell)


def _died(label: str) -> LostError:
    return LostError(
        f"a worker process died during the training of {label} (out of memory, or stopped from outside; a calling "
        "script needs `if __name__ == '__main__':`); run the same command again with --workers 1"
    )


class _Display:
    """Shows of trainings side by side the one that has the longest to go."""

    def __init__(self, jobs: Sequence[CandidateTraining], progress: Progress) -> None:
        self.jobs, self.progress = jobs, progress
        self.last: TrainingProgress | None = None

    def look(self) -> None:
        """Read the notes, and pass on what is new."""
        noted = [(job, event) for job in self.jobs if (event := _noted(job)) is not None]
        if not noted:
            return
        job, event = max(noted, key=lambda pair: pair[1].seconds_left)
        if event != self.last:
            training_steps(self.progress.stage(job.label))(event)
        self.last = event


def _noted(job: CandidateTraining) -> TrainingProgress | None:
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
