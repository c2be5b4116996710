"""Fine-tuning of a network of one machine with the logs of another, compared with baselines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from edp import __version__
from edp.config.experiment import Change, Experiment
from edp.data.frozen import refuse_frozen
from edp.data.prepared import Prepared, prepare
from edp.data.series import Series
from edp.errors import ConfigError
from edp.evaluation.scores_file import ScoredTarget
from edp.evaluation.transfer_file import MethodScores, PartMinutes, TransferData, TransferFile, TransferTask
from edp.jobs import IN_PROCESS, Workers
from edp.jobs.workers import WorkUnit
from edp.logs.source import DataSource
from edp.networks.predictor import describe
from edp.progress import SILENT, Progress
from edp.signals import KINDS
from edp.storage import write_bytes
from edp.storage.headers import digests_of
from edp.storage.ledger import TrainingIdentity
from edp.storage.paths import full_path
from edp.storage.runs import Run, check_claimable, check_visible
from edp.training import Diverged
from edp.training.bundle import weights_digest
from edp.training.transfer.checks import check_channels, check_lengths, check_moving, check_signs, check_units
from edp.training.transfer.spec import FinetuneSpec
from edp.workflows.transfer.case import TransferCase, tuned
from edp.workflows.transfer.methods import METHODS, Made, Method, code_names
from edp.workflows.transfer.scores import MeasuredMethod, distributions, errors_of, excerpts, measure
from edp.workflows.transfer.source import SourceModel, read_source, target_experiment

KIND, SHOWN = "transfer", "transfer_predictions.safetensors"
BEFORE = "direct"
RENAMED = {"replay": "rehearsal", "replay_distilled": "rehearsal_distilled"}
"""Methods by their former names; ``edp adapt replay`` evaluates a log with an adapted network and mixes no data."""


@dataclass(frozen=True, kw_only=True)
class FinetuneRequest:
    """Request of a transfer.

    Attributes:
        spec: phases, rates and regularisers.
        method: name of the method whose network is kept as the run.
        baselines: names of further methods; direct transfer is always among them.
        changes: settings of the trainings that differ from those of the source: ``key.path=value``, or tables.

    Raises:
        ConfigError: an unknown method, a former name of one, or one that leaves no network as `method`.
    """

    spec: FinetuneSpec = field(default_factory=FinetuneSpec)
    method: str = "full"
    baselines: tuple[str, ...] = ()
    changes: tuple[Change, ...] = ()

    def __post_init__(self) -> None:
        for name in (self.method, *self.baselines):
            if name in RENAMED:
                raise ConfigError(f"method '{name}' is now called '{RENAMED[name]}'; give that name")
            # Unknown methods fail before hours of training.
            _ = METHODS[name]
        if not METHODS[self.method].trains:
            trainable = ", ".join(name for name, method in METHODS.items() if method.trains)
            raise ConfigError(
                f"method '{self.method}' trains nothing, so it leaves no run; one of {trainable} must be given"
            )

    @property
    def names(self) -> list[str]:
        """Return all methods: the selected method, direct transfer, and the others in the order of the registry."""
        asked_names = {self.method, BEFORE, *self.baselines}
        first = [self.method, BEFORE]
        return first + [name for name in METHODS if name in asked_names and name not in first]


def finetune(
    source: str | Path,
    logs: DataSource,
    order: FinetuneRequest,
    out: str | Path,
    progress: Progress = SILENT,
    workers: Workers = IN_PROCESS,
) -> TransferFile:
    """Fine-tune a network of one machine with logs of another, compare it with baselines, and write a run folder.

    The source's scaling is carried and never fitted again. Each log is divided by time into training, validation and
    test part with a gap of W + k. The same call goes on after a stop. Baselines lie in ``baselines/`` of the folder.

    Args:
        source: run folder or bundle.
        logs: recordings of the target.
        order: methods and settings.
        out: run folder.
        progress: receiver of the progress; its units are methods.
        workers: who trains; nodes see source, logs and run folder under the same paths.

    Returns:
        The content of ``transfer.json``.

    Raises:
        EdpError: logs that do not go with the source, settings that cannot be, or another run in `out`.
        Diverged: the training of the method that is kept diverged.
    """
    check_claimable(out, KIND)
    begun = read_source(source)
    experiment = target_experiment(begun, order.changes)
    names, notes = _able(begun, order)
    data, repair_notes = target_data(begun, logs, experiment, order)
    notes += repair_notes
    for note in notes:
        progress.note(note)
    if not workers.are_alone:
        _train_elsewhere(source, logs, order, Path(out), [name for name in names if METHODS[name].trains], workers)
    results: dict[str, Made] = {}
    with Run(out, KIND) as run:
        methods = progress.stage("method", len(names))
        for number, name in enumerate(names):
            methods.note(name)
            folder = run if name == order.method else _baseline_folder(run.path, name)
            case = TransferCase(begun, logs, data, experiment, order.spec, folder, methods)
            try:
                results[name] = METHODS[name]().make(case)
            except Diverged as end:
                # The asked method must succeed; baselines may fail with a note.
                if name == order.method:
                    raise
                notes.append(f"{METHODS[name].label} is left out: {end}")
                progress.note(notes[-1])
            methods.step(number + 1)
        result, shown = _result(begun, data, experiment, order, results)
        write_bytes(run.file(SHOWN), save(shown))
        result = replace(result, logs=logs.label, notes=tuple(notes), files=digests_of(run.path, SHOWN))
        result.write(run.path)
        run.finish()
    return result


def _baseline_folder(out: Path, name: str) -> Path:
    return out / "baselines" / name


def _train_elsewhere(
    source: str | Path, logs: DataSource, order: FinetuneRequest, out: Path, names: Sequence[str], workers: Workers
) -> None:
    """Train methods into their run folders, where `finetune` finds them done."""
    changes = [change if isinstance(change, str) else dict(change) for change in order.changes]
    shared = {"source": str(full_path(Path(source))), "logs": logs.visible_to(workers), "out": str(full_path(out))}
    units = []
    for name in names:
        arguments = {"name": name, "method": order.method, "spec": asdict(order.spec), "changes": changes}
        where = {**shared, "order": order}
        units.append(WorkUnit(f"{__name__}:train_unit", f"method '{name}'", arguments, logs.content_key(), where))
    list(workers.map(units))
    if names:
        check_visible(out if order.method in names else _baseline_folder(out, names[0]))


def train_unit(identity: TrainingIdentity, where: Mapping[str, Any]) -> dict[str, str]:
    """Train one method of a fine-tuning, or continue with it; `finetune` reports a diverged method."""
    name, order, out = identity.config["name"], where["order"], where["out"]
    begun = read_source(where["source"])
    experiment = target_experiment(begun, order.changes)
    data, _ = target_data(begun, where["logs"], experiment, order)
    with Run(out, KIND) if name == order.method else nullcontext(_baseline_folder(Path(out), name)) as folder:
        try:
            METHODS[name]().make(TransferCase(begun, where["logs"], data, experiment, order.spec, folder))
        except Diverged as end:
            return {"diverged": str(end)}
    return {}


def _able(source: SourceModel, order: FinetuneRequest) -> tuple[list[str], list[str]]:
    """Return the methods whose needs the source meets, and the others with reasons.

    Raises:
        ConfigError: the method that is to be kept is one of the others.
    """
    lacking = {}
    for name in order.names:
        if METHODS[name].needs_source and source.data is None:
            lacking[name] = f"needs the recordings of the source, which are not there: {source.absent}"
        elif METHODS[name].needs_code and not code_names(source.predictor):
            lacking[name] = (
                "needs a network that reads the code of a machine, which that of the source does not; give one of "
                "edp train pretrain --method codes"
            )
    if order.method in lacking:
        raise ConfigError(f"method '{order.method}' {lacking[order.method]}")
    notes = [f"{METHODS[name].label} is left out: it {why}" for name, why in lacking.items()]
    return [name for name in order.names if name not in lacking], notes


def target_data(
    source: SourceModel, logs: DataSource, experiment: Experiment, order: FinetuneRequest
) -> tuple[Prepared, list[str]]:
    """Split the logs of the target machine and check them against the source machine; return data and notes.

    Raises:
        EdpError: logs that do not go with the source.
    """
    task, window = source.bundle.task, source.predictor.spec.window
    recordings = logs.read()
    refuse_frozen(recordings, source.frozen, "would be trained on")
    check_channels(recordings, task)
    data = prepare(recordings, task, experiment.split, window)
    check_lengths(data, tuned(experiment.training, order.spec).chunks, window)
    check_moving(data)
    check_units(data, source.predictor.front)
    notes = []
    if order.spec.check_signs:
        notes += check_signs(data, source.data)
    if source.data is None:
        notes.append(f"What becomes of the domain of the source was not judged: {source.absent}.")
    return data, notes


def _result(
    source: SourceModel, data: Prepared, experiment: Experiment, order: FinetuneRequest, results: dict[str, Made]
) -> tuple[TransferFile, dict[str, NDArray[np.float32]]]:
    """Return the scores of all methods in both domains, and the predictions before and after that pictures show."""
    # The longest start-up of all methods, so that all are scored on the same ticks.
    skip = max(source.predictor.spec.window, experiment.evaluation.history, data.task.features.init_samples)
    predictions = {name: one.predict(data) for name, one in results.items()}
    errors = {name: errors_of(values, data, skip) for name, values in predictions.items()}
    domains = {"target": {name: measure(values, data, skip) for name, values in predictions.items()}}
    if source.data is not None:
        domains["source"] = {
            name: measure(one.predict(source.data), source.data, skip) for name, one in results.items()
        }
    pair = {name: values for name, values in predictions.items() if name in (BEFORE, order.method)}
    rate = data.task.rate_hz
    facts = [KINDS[kind] for kind in data.target_kinds]

    def minutes(series: Sequence[Series]) -> float:
        return round(sum(one.samples for one in series) / rate / 60, 3)

    result = TransferFile(
        edp=__version__,
        method=order.method,
        before=BEFORE,
        network=describe(source.predictor.spec),
        settings=asdict(order.spec),
        source=source.facts,
        task=TransferTask(horizons=data.task.horizons, rate_hz=rate, skip=skip),
        targets=tuple(
            ScoredTarget(name=name, description=text, unit=fact.report_unit, factor=fact.report_factor)
            for name, text, fact in zip(data.task.targets, data.descriptions, facts, strict=True)
        ),
        data=TransferData(
            recordings=len({part.name.partition("[")[0] for part in data.train}),
            minutes=PartMinutes(
                train=minutes(data.train), validation=minutes(data.validation), test=minutes(data.test)
            ),
        ),
        methods={name: _scores(METHODS[name], one, domains, name) for name, one in results.items()},
        distributions=distributions({name: errors[name] for name in pair}, data.task.targets),
        notes=(),
    )
    return result, excerpts(pair, data, skip)


def _scores(
    method: type[Method], result: Made, domains: dict[str, dict[str, MeasuredMethod]], name: str
) -> MethodScores:
    return MethodScores(
        label=method.label,
        learned=result.learned,
        weights=None if result.network is None else weights_digest(result.network),
        domains={domain: measured[name].overall for domain, measured in domains.items()},
        recordings=domains["target"][name].by_recording,
    )
