"""Separate training of the members of a recurrent twin, each with its own seed, and their average."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError, EdpError
from edp.jobs.workers import WorkUnit
from edp.networks.twin import TwinScales
from edp.networks.twin.recurrent import Recurrent, RecurrentTwin, averaged, member_seed
from edp.networks.twin.static_map import StaticTwin
from edp.storage.ledger import TrainingIdentity
from edp.storage.paths import full_path
from edp.storage.runs import PARTS, KeyedRun, Run
from edp.training.fitted_twin import FittedTwin, FreeRunProgress
from edp.training.free_run import FreeRunSpec, fit_free_runs


@dataclass(frozen=True, eq=False)
class MemberTraining:
    """The training of one network on free runs, ready for another process.

    Attributes:
        label: name in messages.
        twin: untrained.
        train: segments to learn from.
        validation: segments that select among its weights.
        training: settings with the seed of this member.
        folder: folder of its checkpoints, with the key of the run; None for a training that cannot continue.
        trained: whether the twin was trained before, so that its weights as they are may be the best.
    """

    label: str
    twin: RecurrentTwin
    train: Sequence[Series]
    validation: Sequence[Series]
    training: FreeRunSpec
    folder: tuple[Path, str] | None
    trained: bool = False


def train_member(job: MemberTraining, on_event: Callable[[FreeRunProgress], None] | None = None) -> FittedTwin:
    """Train the network of a job; the result is the same in any process.

    Raises:
        EdpError: see `fit_free_runs`.
    """
    what = (job.twin, job.train, job.validation, job.training, on_event)
    if job.folder is None:
        return fit_free_runs(*what, trained=job.trained)
    with Run(job.folder[0]) as folder:
        return fit_free_runs(*what, KeyedRun(folder, job.folder[1]), job.trained)


def member_unit(job: MemberTraining) -> WorkUnit:
    """Return the training of a member, which has a folder, as a unit of work."""
    path, key = job.folder or (Path(), "")
    placed = replace(job, folder=(full_path(path), key))
    arguments = {"folder": str(full_path(path)), "key": key}
    return WorkUnit(f"{__name__}:train_unit", job.label, arguments, "", {"job": placed})


def train_unit(identity: TrainingIdentity, where: Mapping[str, MemberTraining]) -> dict[str, str]:
    """Train a member into its folder, and note there how far the training is.

    Raises:
        EdpError: see `fit_free_runs`.
    """
    job = where["job"]
    if job.folder is None:
        raise ConfigError(f"{job.label} has no folder to be trained in")
    folder = job.folder[0]
    train_member(job, lambda event: event.write(folder))
    return {"trained": job.label}


def read_progress_notes(jobs: Sequence[MemberTraining]) -> FreeRunProgress | None:
    """Combine the latest progress of parallel trainings; None if missing yet."""
    noted = [_read_progress(job) for job in jobs]
    events = [event for event in noted if event is not None]
    if not events:
        return None
    waiting = len(jobs) - len(events)
    errors = [event.validation for event in events if event.validation is not None]
    longest = max(event.seconds_left for event in events)
    return FreeRunProgress(
        sum(event.update for event in events),
        sum(sum(job.training.updates) for job in jobs),
        max(event.length_s for event in events),
        # One that has not begun takes about as long as the slowest has yet to go.
        sum(event.seconds_left for event in events) + waiting * longest,
        sum(errors) / len(errors) if errors else None,
        any(event.best for event in events),
    )


def _read_progress(job: MemberTraining) -> FreeRunProgress | None:
    try:
        return None if job.folder is None else FreeRunProgress.read(job.folder[0])
    except EdpError:
        return None  # a note is for readers: what cannot be read now is read at the next look


def one_by_one(
    jobs: Sequence[MemberTraining], on_event: Callable[[FreeRunProgress], None] | None
) -> Iterator[FittedTwin]:
    """Train networks in this process, in order.

    Raises:
        EdpError: see `fit_free_runs`.
    """
    return (train_member(job, on_event) for job in jobs)


TrainAll = Callable[[Sequence[MemberTraining], Callable[[FreeRunProgress], None] | None], Iterable[FittedTwin]]
"""How several networks are trained: one by one as `one_by_one` does, or side by side."""


def fit_members(
    form: Recurrent,
    parts: tuple[TwinChannels, TwinScales, StaticTwin | None],
    series: tuple[Sequence[Series], Sequence[Series]],
    training: FreeRunSpec,
    on_event: Callable[[FreeRunProgress], None] | None = None,
    run: KeyedRun | None = None,
    train_all: TrainAll = one_by_one,
) -> FittedTwin:
    """Train each member of a recurrent twin on its own free runs, and average them.

    Args:
        form: its options.
        parts: channels, scales, and the fitted static map that all members share, where there is one.
        series: training segments, and those that choose among the weights of each member.
        training: settings; the first member has this seed, the others have their own.
        on_event: called with progress of each member in turn.
        run: folder and key of the run; where given, each member's training is resumable.
        train_all: function that trains the members.
    """
    if form.members == 1:
        return fit_free_runs(form.member(*parts, training.seed), *series, training, on_event, run)
    jobs = []
    for which in range(form.members):
        seed = member_seed(training.seed, which)
        folder = None if run is None else (run.folder.path / PARTS / f"member_{which}", run.key)
        seeded = replace(training, seed=seed)
        jobs.append(MemberTraining(f"member {which + 1}", form.member(*parts, seed), *series, seeded, folder))
    return join_members(list(train_all(jobs, on_event)))


def join_members(fits: Sequence[FittedTwin]) -> FittedTwin:
    """Return the members that were trained apart, on one map and with one scale, as one twin.

    Returns:
        The average, the rows of all trainings one behind the other (each with its ``member`` where there are
        several), and the processor time of all.
    """
    if len(fits) == 1:
        return fits[0]
    rows = [row | {"member": which} for which, fit in enumerate(fits) for row in fit.history]
    twins = [fit.twin for fit in fits if isinstance(fit.twin, RecurrentTwin)]
    return FittedTwin(averaged(twins), rows, sum(fit.seconds for fit in fits))
