"""The main jobs as functions: simulate, train, evaluate, report. The command line and scripts call the same ones."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import torch
from safetensors.numpy import save

from edp.config.experiment import Experiment, build, experiment_toml, load_experiment, plain_tree
from edp.data.frozen import list_frozen, refuse_frozen
from edp.data.prepared import Prepared, prepare
from edp.errors import DataError
from edp.evaluation.channel_importance import ChannelImportances, ChannelImportanceSpec, measure_channel_importance
from edp.evaluation.conditional import collinear
from edp.evaluation.footprint import footprint
from edp.evaluation.judge import (
    Evaluation,
    JudgedModel,
    JudgedPart,
    JudgeSpec,
    ModelBench,
    check_scored,
    first_scored,
    judge,
    network_parts,
    score_network,
    sort_by_effort,
)
from edp.evaluation.scores_file import PREDICTIONS, DrawnSample, ModelScores, ScoresFile, earlier_scores
from edp.jobs import IN_PROCESS, Workers
from edp.jobs.packing import pack, unpack
from edp.jobs.workers import UNITS, WorkUnit, forget_units
from edp.logs.as_before import read_as_before
from edp.logs.source import DataSource
from edp.networks.predictor import check_combination, describe
from edp.progress import SILENT, Progress
from edp.recording import Recording
from edp.report import build_report
from edp.report.run.choice import FLOOR, note_test_result
from edp.settings.provenance import Provenance, read_provenance
from edp.storage import check_writable, make_folder, write_bytes, write_json
from edp.storage.headers import digests_of
from edp.storage.ledger import TrainingIdentity, WithState
from edp.storage.paths import full_path, is_folder_at, is_there
from edp.storage.provenance import PROVENANCE
from edp.storage.runs import KeyedRun, Run, check_claimable, run_key
from edp.training import Bundle, Diverged, Fitted, TrainingProgress, load_bundle, make_bundle, save_bundle
from edp.training.blas import one_blas_thread
from edp.training.bundle import weights_digest
from edp.training.fit import fit
from edp.training.provenance import training_provenance
from edp.training.spec import check_fitted_parts, check_training, thread_count
from edp.training.strategy import DirectFit, TrainingStrategy
from edp.workflows.judged_data import judged_data

if TYPE_CHECKING:
    from edp.sim.data_set import SimulationOrder, simulate_data_set


NETWORK = "network"


class RecordingSource(Protocol):
    """Source of recordings."""

    def read(self) -> list[Recording]:
        """Read all recordings."""
        ...


def prepare_data(source: RecordingSource, experiment: Experiment, frozen: Mapping[str, str] | None = None) -> Prepared:
    """Read and cut a data set for an experiment.

    Args:
        source: source of the recordings.
        experiment: the settings.
        frozen: names of sessions by digest that must not be among them, unless the split keeps them frozen.

    Raises:
        EdpError: recordings or settings that cannot be used, or a frozen session that would train.
    """
    recordings = source.read()
    # Sessions that this split freezes itself are allowed to stay in its test part.
    others = {key: name for key, name in (frozen or {}).items() if key not in list_frozen(experiment.split)}
    refuse_frozen(recordings, others, "would be divided into training and test part")
    first = recordings[0]
    task = experiment.task.resolve(first.rate_hz, first.channel_names, experiment.model.physics)
    # Contradictions come before hours of reading features.
    check_combination(task, experiment.model)
    check_training(task, experiment.model, experiment.training)
    return prepare(recordings, task, experiment.split, experiment.model.window)


@dataclass(frozen=True)
class StrategyFactory:
    """Factory of the strategy of a training: its parts apart from data and settings.

    Attributes:
        facts: plain values that decide what is taught; they are part of the run's key and provenance.
        strategy: makes the strategy for the prepared data.
        frozen: names by digest of sessions that stay frozen for what comes of the run, beside those of its split.
    """

    facts: Mapping[str, object]
    strategy: Callable[[Prepared], TrainingStrategy | DirectFit]
    frozen: Mapping[str, str] = field(default_factory=dict)


@one_blas_thread()
def train(
    source: DataSource,
    experiment: Experiment,
    out: str | Path | Run,
    on_event: Callable[[TrainingProgress], None] | None = None,
    strategy_factory: StrategyFactory | None = None,
    data: Prepared | None = None,
) -> Bundle:
    """Train on a data set and write a run folder with its bundle; an interrupted run continues.

    Args:
        source: source of the recordings.
        experiment: the settings.
        out: run folder; or a run that the caller has opened, and of which this training is a part.
        on_event: called with progress.
        strategy_factory: teachers, weights to begin with.
        data: result of `prepare_data` for this source and experiment, if available.

    Raises:
        EdpError: the data, settings or folder cannot be used; what was on disk stays.
        Diverged: the loss was not finite any more, now or in an earlier sitting; a bundle holds the best weights
            before that, where an epoch was finished.
    """
    check_claimable(out, "network")
    # The judge changes no weights: the same run may be judged in several ways.
    settings = {part: values for part, values in plain_tree(experiment).items() if part != "evaluation"}
    if experiment.model.physics is not None:  # an unknown machine is reported before recordings are read
        # The machine's numbers are part of the key: its file may change under the same name.
        settings["machine"] = experiment.model.physics.digest()
    if strategy_factory is None:  # weights to begin with bring fitted trees along
        check_fitted_parts(experiment.model, experiment.training)
    taught = {} if strategy_factory is None else {"strategy": dict(strategy_factory.facts)}
    frozen = {} if strategy_factory is None else strategy_factory.frozen
    data = data or prepare_data(source, experiment, frozen)
    check_scored(data, experiment.evaluation)
    key = run_key(settings | taught, data.digest)
    with Run.create(out, "network", key, experiment_toml(experiment)) as run:
        _refuse_diverged(run)
        try:
            strategy = None if strategy_factory is None else strategy_factory.strategy(data)
            fitted = fit(data, experiment.model, experiment.training, KeyedRun(run, key), on_event, strategy)
        except Diverged as end:
            if end.fitted is not None:
                # Without weights from before the divergence there is nothing to keep.
                provenance = _provenance(source, experiment, data, end.fitted.seconds, frozen)
                _keep(run, end.fitted, provenance.add_entries(**taught, diverged=str(end)), data)
            run.write_status("diverged", message=str(end), **end.facts)
            raise
        provenance = _provenance(source, experiment, data, fitted.seconds, frozen).add_entries(**taught)
        return _keep(run, fitted, provenance, data)


def keep_fitted(
    run: Run, source: DataSource, experiment: Experiment, data: Prepared, fitted: Fitted, facts: Mapping[str, object]
) -> Bundle:
    """Write what `train` writes into an open run, for a training that took place elsewhere.

    Args:
        run: the run.
        source: source of the recordings.
        experiment: the settings.
        data: result of `prepare_data` for both.
        fitted: result of the training.
        facts: further plain values of the provenance.
    """
    run.write_settings(experiment_toml(experiment))
    run.write_history(fitted.history)
    provenance = _provenance(source, experiment, data, fitted.seconds, {}).add_entries(**facts)
    return _keep(run, fitted, provenance, data)


def _keep(run: Run, fitted: Fitted, provenance: Provenance, data: Prepared) -> Bundle:
    """Write the results of a training: provenance, footprint and the bundle."""
    write_json(run.file(PROVENANCE), provenance.to_table())
    write_json(run.file("footprint.json"), footprint(fitted.predictor).to_json())
    bundle = make_bundle(fitted.predictor, data, provenance)
    save_bundle(bundle, run.file("bundle"))
    return bundle


def _refuse_diverged(run: Run) -> None:
    """Refuse a diverged run, which would diverge again with the same bits."""
    # Every training is deterministic: trying again would take as long and end alike.
    status = run.status()
    if status.get("status") == "diverged":
        bundle_note = " Its bundle holds the weights from before." if is_there(run.file("bundle")) else ""
        raise Diverged(
            f"the run in '{run.path}' diverged on {status['time']}: {status['message']}. The same settings would do so "
            f"again.{bundle_note} Change them and choose another folder with --out, or remove this one",
            None,
            {name: status[name] for name in ("epoch", "update", "kept_epoch")},
        )


def _provenance(
    source: DataSource, experiment: Experiment, data: Prepared, seconds: float, frozen: Mapping[str, str]
) -> Provenance:
    training = experiment.training
    sealed = {**frozen, **list_frozen(experiment.split)}
    provenance = training_provenance(source, data, training.seed, thread_count(training), seconds, sealed)
    return provenance.add_entries(regime=training.chunks.regime, device=training.device)


@one_blas_thread()
def evaluate(
    run: str | Path,
    source: DataSource | None = None,
    baselines: Sequence[str] | None = None,
    progress: Progress = SILENT,
    minutes: float | None = None,
    workers: Workers = IN_PROCESS,
    at_most_h: float | None = None,
) -> Path:
    """Evaluate a run on its held-out recordings, or on others, with baselines trained on its training data.

    Scores of the same weights, recordings and settings are kept, not computed again.

    Args:
        run: run folder.
        source: other recordings. Logs without a map are read with that of the run.
        baselines: names; None takes those of the settings.
        progress: receiver of the name of each model.
        minutes: after which no further baseline is begun; a later call evaluates it. Not for several processes.
        workers: who runs the models; nodes see run and recordings under the same paths. What a stopped call measured is
            not measured again.
        at_most_h: evaluate on evenly spread segments of so many hours, about, where there are more; None evaluates on
            all.

    Returns:
        The folder with ``scores.json`` and ``predictions.safetensors``: the run folder, or one in it for `source`.
    """
    folder = Path(run)
    _check_run_writable(folder)
    bundle, experiment, provenance, data = read_trained_run(folder)
    target, judged, others = folder, [data.digest], other_recordings(source, provenance)
    if source is not None:
        # Content by name and digest: the same file changed is another judgement.
        judged += [part for recording in others or () for part in (recording.name, recording.digest)]
        target = make_folder(folder / f"on_{source.short_name}")
    data, drawn = judged_data(bundle, data, others, at_most_h)
    judged += [part.name for part in data.test] if drawn else []
    chosen = experiment.evaluation if baselines is None else replace(experiment.evaluation, baselines=tuple(baselines))
    settings = plain_tree(replace(experiment, evaluation=chosen))["evaluation"]
    # Settings may leave the first tick to what models need, which versions have seen differently.
    how = {"judge": settings, "first": first_scored(bundle.predictor, data, chosen)}
    key = run_key(how | {"weights": weights_digest(bundle.predictor)}, " ".join(judged))
    scores = earlier_scores(target, key)
    if scores is None:
        bench = ModelBench(bundle.predictor, data, chosen)
        other = json.dumps(None if source is None else source.to_dict(), sort_keys=True)
        at = EvaluatedRun(str(full_path(folder)), other, at_most_h)
        evaluation = _evaluate_models(bench, at, " ".join(judged), workers, progress, minutes)
        # Scores that lack a baseline are not kept for a call that asks for all.
        write_bytes(target / PREDICTIONS, save(evaluation.tensors))
        scores = replace(
            evaluation.scores,
            drawn=None if drawn is None else DrawnSample(**asdict(drawn), what=drawn.what),
            key="" if evaluation.scores.left_out else key,
            files=digests_of(target, PREDICTIONS),
        )
        scores.write(target)
    forget_units(folder / UNITS)
    if source is None:
        note_test_result(folder, scores, _floor_scores(folder, data, scores))
        save_bundle(replace(bundle, scores=dict(scores.models["network"].overall)), folder / "bundle")
    return target


@dataclass(frozen=True)
class EvaluatedRun:
    """Location of evaluated data for a process: run folder, other recordings as JSON, and maximum hours."""

    run: str
    source: str
    at_most_h: float | None


def _evaluate_models(
    bench: ModelBench, at: EvaluatedRun, digest: str, workers: Workers, progress: Progress, minutes: float | None
) -> Evaluation:
    """Evaluate the network in parts, and every baseline, as units of work."""
    parts = network_parts(bench.data)
    names = sort_by_effort(bench.spec.baselines)
    where = {"run": at} | ({"bench": bench} if workers.are_alone else {})
    folder = Path(at.run)
    units = [
        _unit(NETWORK if parts == 1 else f"network, part {part + 1}", {"part": part}, bench.spec, digest, where)
        for part in range(parts)
    ] + [_unit(name, {"model": name}, bench.spec, digest, where) for name in names]
    if not workers.are_alone:
        # Costly ones first, so that none of them begins last; parts of the network, all alike, fill what is left.
        units.reverse()
    measured: dict[int, JudgedPart] = {}
    judged: dict[str, JudgedModel] = {}
    began = time.perf_counter()
    for number, result in workers.map(units, progress.stage("model", len(units)), folder / UNITS):
        arguments, content = units[number].arguments, result.content or b""
        if "part" in arguments:
            measured[arguments["part"]] = unpack(content, JudgedPart)
        else:
            judged[arguments["model"]] = unpack(content, JudgedModel)
        if minutes is not None and len(measured) == parts and time.perf_counter() - began > 60 * minutes:
            break
    label, seconds = describe(bench.predictor.spec), read_provenance(folder).seconds or 0.0
    network = bench.network_of((measured[part] for part in range(parts)), label, seconds)
    models = {NETWORK: network} | {name: judged[name] for name in names if name in judged}
    return bench.together(models, [name for name in names if name not in judged])


def _unit(
    label: str, does: Mapping[str, str | int], spec: JudgeSpec, digest: str, where: Mapping[str, object]
) -> WorkUnit:
    return WorkUnit(f"{__name__}:evaluate_unit", label, {**does, "judge": plain_tree(spec)}, digest, where)


@one_blas_thread()
def evaluate_unit(identity: TrainingIdentity, where: Mapping[str, Any]) -> WithState:
    """Evaluate one baseline, or the network of a run on one part."""
    bench = where.get("bench")
    if bench is None:
        bench = _open_bench(where["run"], identity.data, build(JudgeSpec, identity.config["judge"], "of the unit"))
    if "part" in identity.config:
        return WithState({}, pack(bench.network_part(identity.config["part"])))
    return WithState({}, pack(bench.baseline(identity.config["model"])))


@lru_cache(maxsize=1)
def _open_bench(evaluated_run: EvaluatedRun, digest: str, spec: JudgeSpec) -> ModelBench:
    """Return a run with its data, read once for all units of a process; `digest` identifies the data."""
    bundle, _, provenance, data = read_trained_run(Path(evaluated_run.run))
    other = json.loads(evaluated_run.source)
    others = other_recordings(None if other is None else DataSource.from_dict(other), provenance)
    data, _ = judged_data(bundle, data, others, evaluated_run.at_most_h)
    return ModelBench(bundle.predictor, data, spec)


def other_recordings(source: DataSource | None, provenance: Provenance) -> list[Recording] | None:
    """Return other recordings, by default read with the run's map; None for the held-out recordings."""
    return None if source is None else read_as_before(source, provenance.origin.reader).read()


def _check_run_writable(folder: Path) -> None:
    """See before minutes of work that a run folder can be written; a missing one is reported by its reader."""
    if is_folder_at(folder):
        check_writable(folder)


def read_trained_run(folder: Path) -> tuple[Bundle, Experiment, Provenance, Prepared]:
    """Return bundle, settings, provenance and data of a run, after a check of the data against the training data.

    Raises:
        EdpError: not a run folder of EDP, or its recordings changed since.
    """
    bundle = load_bundle(folder)
    provenance = read_provenance(folder)
    experiment = load_experiment(folder / "config.toml", preset=None)
    torch.set_num_threads(thread_count(experiment.training))  # the ticks of a stream are too small to share
    data = prepare_data(DataSource.from_dict(provenance.origin.reader), experiment, provenance.origin.frozen)
    if data.digest != provenance.origin.digest:
        raise DataError(
            f"the recordings in '{provenance.origin.source}' changed since '{folder}' was trained; the held-out "
            "split would not be the same: train again, or judge other recordings with --data"
        )
    return bundle, experiment, provenance, data


def channel_importance(
    run: str | Path,
    source: DataSource | None = None,
    spec: ChannelImportanceSpec | None = None,
    progress: Progress = SILENT,
    at_most_h: float | None = None,
) -> tuple[ChannelImportances, Path]:
    """Return the importance of each input channel to a run's network, on its held-out recordings or on others.

    Args:
        run: run folder.
        source: other recordings.
        spec: method of removing channels; by default collinear channels are also removed together.
        progress: receiver of the progress; its units are channels, or groups of them.
        at_most_h: see `evaluate`.

    Returns:
        The figures, and their file ``channel_importance.json`` in the run folder, or in its subfolder for `source`.
    """
    folder = Path(run)
    _check_run_writable(folder)
    bundle, _, provenance, data = read_trained_run(folder)
    target = folder
    data, _ = judged_data(bundle, data, other_recordings(source, provenance), at_most_h)
    if source is not None:
        target = make_folder(folder / f"on_{source.short_name}")
    if spec is None:
        groups = collinear([part.inputs for part in data.train])
        spec = ChannelImportanceSpec(groups=tuple(tuple(data.task.inputs[i] for i in group) for group in groups))
    importances = measure_channel_importance(bundle.predictor, data, spec, progress)
    write_json(target / "channel_importance.json", {"schema": 1} | importances.to_json())
    return importances, target / "channel_importance.json"


def _floor_scores(folder: Path, data: Prepared, scores: ScoresFile) -> ModelScores | None:
    """Return scores on the same ticks of the reference of the preset auto's skill; None without one."""
    if not is_folder_at(folder / FLOOR):
        return None
    floor = load_bundle(folder / FLOOR).predictor
    return score_network(floor, data, scores.task.skip)


def judge_bundle(bundle: Bundle, data: Prepared, spec: JudgeSpec | None = None) -> Evaluation:
    """Evaluate a bundle on ``data.test`` without touching the disk."""
    return judge(bundle.predictor, data, spec or JudgeSpec(), describe(bundle.predictor.spec))


def __getattr__(name: str) -> Any:
    """Return the simulator's functions late: they import a compiler, which no training process needs."""
    if name in ("SimulationOrder", "simulate_data_set"):
        from edp.sim import data_set

        return getattr(data_set, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "DataSource",
    "SimulationOrder",
    "StrategyFactory",
    "build_report",
    "channel_importance",
    "evaluate",
    "judge_bundle",
    "prepare_data",
    "read_trained_run",
    "simulate_data_set",
    "train",
]
