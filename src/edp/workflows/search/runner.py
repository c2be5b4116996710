"""A whole search: data read and bound, sessions set apart, phases walked through, everything written down."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import tomli_w

from edp.config.experiment import plain_tree
from edp.data.frozen import SECOND_TEST_SET, ByFrozen
from edp.errors import ConfigError, DataError
from edp.evaluation.study import Decision, SessionSets, StudyData, StudyFile, facts_of_kind
from edp.evaluation.study_facts import ExplorationFacts, SynthesisFacts
from edp.jobs import Workers
from edp.logs.source import DataSource
from edp.progress import SILENT, Progress
from edp.recording import Recording
from edp.settings.bounds import above, check_bounds
from edp.signals import KINDS
from edp.storage import make_folder, write_bytes
from edp.storage.ledger import Ledger, Record, check_uncoordinated
from edp.wording import typed
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import SearchContext, is_enough, set_apart
from edp.workflows.search.engine import Dispatcher, run_phases
from edp.workflows.search.networks import freeze_split, write_networks
from edp.workflows.search.phases import PHASES
from edp.workflows.search.plan import SearchPlan, plain_spec
from edp.workflows.search.sessions import SESSIONS_FILE, divide_logs
from edp.workflows.search.study_log import StudyLog
from edp.workflows.search.trainings import Outcome, TrainingRequest

TEST_SET = "test sessions"
TEACHER = "teacher.toml"
MAX_SECONDS, MAX_MB = 31_557_600.0, 1e9  # a year, a petabyte: caps beyond cap nothing


@dataclass(frozen=True, kw_only=True)
class Resources(Workers):
    """Processes that execute the trainings of a search, and limits of each training.

    Attributes:
        count: number of processes of this machine; 0 for the number of cores divided by `threads`.
        seconds: limit of the time of a training, s.
        memory_mb: limit of its memory, MB.

    Raises:
        ConfigError: a number out of range, or workers of this machine and a cluster.
    """

    count: int = 0
    seconds: float | None = None
    memory_mb: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bounds("search", self, seconds=above(0.0, MAX_SECONDS), memory_mb=above(0.0, MAX_MB))


@dataclass(frozen=True)
class SearchResult:
    """Results of a search until now.

    Attributes:
        folder: folder of the study.
        context: context with the decisions.
        state: ``finished``, or ``stopped`` where not all phases were to run.
        digest: hash over the results of all trainings.
        trained: trainings of this sitting.
        source: source of the sessions; a data-set file in the study if the logs were divided.
        teacher: settings of the winner as an experiment file; None before phase 4.
        networks: runs that phase 6 left: the teacher, and the network that was chosen; none before.
    """

    folder: Path
    context: SearchContext
    state: str
    digest: str
    trained: int
    source: DataSource
    teacher: Path | None = field(default=None)
    networks: Mapping[str, Path] = field(default_factory=dict)


def run_search(
    source: DataSource,
    plan: SearchPlan,
    folder: str | Path,
    resources: Resources | None = None,
    until: str | None = None,
    progress: Progress = SILENT,
) -> SearchResult:
    """Search, or continue a stopped search.

    Args:
        source: source of the recordings; each recording is a session.
        plan: plan of the search.
        folder: folder of the study: ``ledger``, ``study.json`` and, at the end, ``teacher.toml`` and ``networks``.
        resources: who does the trainings.
        until: name of the last phase to run.
        progress: receiver of the progress: stages are phases, units are trainings, notes are what was decided.

    Raises:
        BusyError: another process searches in this folder.
        ConfigError: the study was begun with other data, space, settings or network; an unknown phase.
        DataError: recordings that are the same session twice, too few of them, or without a channel that is needed.
        LostError: the processes of a training were killed again and again.
        StorageError: the disk is full or the folder cannot be written; what was done stays.
    """
    resources = resources or Resources()
    if until is not None:
        _ = PHASES[until]
    check_uncoordinated(Path(folder) / "ledger")
    # Before anything is made on disk: what is refused leaves no folder.
    recordings = source.read()
    # Samples that a prediction reads and looks ahead.
    reach = plan.experiment.model.window + max(plan.experiment.task.horizons)
    parts = None if is_enough(len(recordings), plan.spec) else divide_logs(source, recordings, reach)
    data = _Data.from_recordings(recordings if parts is None else parts.recordings, plan)
    development, test, second = set_apart(data.names, data.families, plan.spec)
    target = make_folder(folder)
    if parts is not None:
        source = DataSource(target / SESSIONS_FILE)
        progress.note(
            f"too few logs for sessions ({len(recordings)}): divided into {len(data.names)} sessions of "
            f"{typed(parts.seconds, 3)} s or more ({source.path}); what is found holds for these logs, not for other "
            "days"
        )
    with ExitStack() as open_things:
        ledger = open_things.enter_context(Ledger(target / "ledger"))
        if ledger.damaged:
            progress.note(f"{len(ledger.damaged)} damaged records were set apart and will be trained again")
        # A folder is bound to data and settings: another search in it would mix records.
        ledger.bind({"data": data.digest, **plan.to_dict()})
        if parts is not None:
            write_bytes(source.path, parts.data_set().encode())
        base = Arm.from_experiment(plan.experiment)
        context = SearchContext(
            plan.spec, base, source.to_dict(), development, test, data.channels, data.unit, second=second
        )
        study_log = StudyLog(target, _study(plan, data, source, context), context)
        executor = open_things.enter_context(resources.open())
        study_log.workers = executor.workers
        observer = _Observer(ledger, study_log, context, progress)
        dispatcher = Dispatcher(
            ledger,
            executor,
            data.digest,
            resources.threads,
            resources.seconds,
            resources.memory_mb,
            observer.on_batch,
            observer.on_record,
        )
        state = "stopped"
        try:
            context = run_phases(context, dispatcher, until, observer.on_decision, on_phase=observer.on_phase)
            # States were for going on; at the end nothing reads them.
            ledger.keep_states(())
            state = "finished" if len(context.decided) == len(PHASES) else "stopped"
        finally:
            # Openings are written down even where the search ends with an error.
            study_log.openings = ledger.openings()
            study_log.end(state)
        split = freeze_split(target, context, data.digests)
        networks = write_networks(target, source, context, split, list(observer.second.values()))
        teacher = _write_teacher(target, context, split)
        return SearchResult(target, context, state, ledger.digest(), study_log.trained, source, teacher, networks)


@dataclass(frozen=True)
class _Data:
    """Facts on a search's recordings, which only the trainings read."""

    names: tuple[str, ...]
    families: dict[str, str]
    channels: tuple[str, ...]
    digest: str
    hours: float
    unit: str
    digests: dict[str, str]

    @staticmethod
    def from_recordings(recordings: Sequence[Recording], plan: SearchPlan) -> _Data:
        _refuse_twice(recordings)
        unit = _check_channels(recordings, plan)
        names = tuple(recording.name for recording in recordings)
        # Names such as m22_003_dig say what a session is of; a kind with one session is no kind.
        kinds = {name: re.sub(r"\d+", "", name) for name in names}
        count = Counter(kinds.values())
        families = {name: kind if count[kind] > 1 else "" for name, kind in kinds.items()}
        state = hashlib.blake2b(digest_size=16)
        for recording in recordings:
            # The zero byte separates name and digest, so that no pair can be shifted into another.
            state.update(f"{recording.name}\0{recording.digest}\0".encode())
        hours = sum(recording.duration_s for recording in recordings) / 3600
        digests = {recording.name: recording.digest for recording in recordings}
        return _Data(names, families, recordings[0].channel_names, state.hexdigest(), hours, unit, digests)


class _Observer:
    """Observer that reports events, and opens a sealed test set before a batch is evaluated on its sessions.

    Attributes:
        second: outcomes of trainings that were evaluated on the second test set, by key.
    """

    def __init__(self, ledger: Ledger, study_log: StudyLog, context: SearchContext, progress: Progress) -> None:
        self.ledger, self.study_log, self.context = ledger, study_log, context
        self.progress = self.stage = progress
        self.second: dict[str, Outcome] = {}

    def on_phase(self, name: str, context: SearchContext) -> None:
        self.study_log.on_phase(name, context)
        phase = self.progress.stage(f"phase {list(PHASES).index(name) + 1} of {len(PHASES)}, {PHASES[name].title}")
        self.stage = phase.stage("training", self.study_log.counts().total)
        self.study_log.report(self.stage)

    def on_batch(self, batch: Mapping[str, TrainingRequest]) -> None:
        for test_set, sessions, why in (
            (TEST_SET, self.context.test, "phase 4: its winner and the baseline, trained at length"),
            (SECOND_TEST_SET, self.context.second, "phase 6: the chosen network and its teacher"),
        ):
            sealed = sorted({key for key, order in batch.items() if set(order.judged) & set(sessions)})
            if sealed:
                self._open(test_set, sealed, why)
        self.study_log.on_batch(batch)
        self.study_log.report(self.stage)

    def _open(self, test_set: str, keys: Sequence[str], why: str) -> None:
        """Record an opening before it is made; `edp compress search` may have opened the second test set earlier."""
        # Recorded before it is made: a kill in between must not leave an opening without a trace.
        earlier = [one for one in self.ledger.openings(test_set) if one.judged != tuple(keys)]
        self.ledger.open_test_set(test_set, keys, why, again=test_set == SECOND_TEST_SET)
        if earlier:
            self.progress.note(
                f"sealed test set '{test_set}' was opened on {earlier[0].time} ({earlier[0].why}), so this one "
                "shows less"
            )
        self.study_log.openings = self.ledger.openings()

    def on_record(self, record: Record, order: TrainingRequest, trained: bool) -> None:
        if record.result is not None and set(order.judged) & set(self.context.second):
            self.second[record.key] = Outcome.from_record(order, record)
        self.study_log.on_record(record, order, trained)
        self.study_log.report(self.stage)

    def on_decision(self, decision: Decision) -> None:
        self.study_log.on_decision(decision)
        for sentence in decision.sentences:
            self.progress.note(sentence)


def _refuse_twice(recordings: Sequence[Recording]) -> None:
    """Refuse duplicate sessions, which would both train and evaluate."""
    seen: dict[str, str] = {}
    for recording in recordings:
        if recording.digest in seen:
            raise DataError(
                f"'{recording.name}' and '{seen[recording.digest]}' are the same session, value for value; one of "
                "them would train and the other judge, or test: remove one (edp data check names all that repeat)"
            )
        seen[recording.digest] = recording.name


def _check_channels(recordings: Sequence[Recording], plan: SearchPlan) -> str:
    """See that every feature set can be had of every recording; the unit of the scores."""
    units: set[str] = set()
    kinds: dict[tuple[str, ...], Recording] = {}
    for recording in recordings:
        # Recordings of equal channels need one check.
        kinds.setdefault(recording.channel_names, recording)
    for name, features in plan.spec.feature_sets.items():
        arm = Arm.from_experiment(plan.experiment).with_value("task.features", features)
        experiment = arm.experiment("of the search")
        for recording in kinds.values():
            try:
                names = recordings[0].channel_names
                task = experiment.task.resolve(recording.rate_hz, names, experiment.model.physics)
                task.series(recording)
                units |= {KINDS[kind].report_unit for kind in task.kinds(recording)}
            except (ConfigError, DataError) as error:
                raise DataError(
                    f"feature set {name} cannot be had of '{recording.name}': {error}; name others with --set "
                    "search.features=[...] (a file of edp data screen is one)"
                ) from error
    return units.pop() if len(units) == 1 else "mixed units"


def _study(plan: SearchPlan, data: _Data, source: DataSource, context: SearchContext) -> StudyFile:
    return StudyFile(
        state="running",
        mode=plan.spec.mode,
        unit=data.unit,
        preset=plan.preset,
        data=StudyData(source.label, len(data.names), round(data.hours, 4), data.digest),
        spec=plain_spec(plan.spec),
        sessions=SessionSets(context.development, context.test, context.second),
        modules={},
        decisions=(),
        phases=(),
        history=(),
        openings=(),
    )


def _write_teacher(folder: Path, context: SearchContext, split: ByFrozen) -> Path | None:
    """Write the winner's settings with the frozen sessions, for `edp train --config`."""
    decisions = list(context.decided.values())
    explored, joined = facts_of_kind(decisions, ExplorationFacts), facts_of_kind(decisions, SynthesisFacts)
    if joined is None:
        return None
    settings = joined.settings if explored is None else explored.teacher_settings
    file = folder / TEACHER
    write_bytes(file, tomli_w.dumps({**settings, "split": plain_tree(split, "split")}).encode())
    return file
