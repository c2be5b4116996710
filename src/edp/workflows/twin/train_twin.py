"""Training of a twin into a run folder, with free-run scores of the twin and its baselines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edp.config.twin import TWIN_SETTINGS, TwinExperiment, twin_toml
from edp.data.oil import oil_celsius
from edp.data.prepared import Prepared
from edp.data.twin_channels import TwinChannels
from edp.evaluation.beyond import RANGES, command_ranges
from edp.evaluation.free_run import calibrated, check_runs
from edp.evaluation.free_run_file import CandidatesFile, FreeRunScores, read_models
from edp.evaluation.step_response import step_responses
from edp.jobs import IN_PROCESS, Workers
from edp.logs.source import DataSource
from edp.networks.twin import fit_scales
from edp.networks.twin.grey.channel_map import FARTHEST_TURN
from edp.networks.twin.grey.datasheet import BASIS
from edp.networks.twin.greybox import GreyBox
from edp.networks.twin.model_selection import AutoTwin
from edp.networks.twin.parameters import Datasheet
from edp.networks.twin.recurrent_members import scales_for
from edp.progress import SILENT, Progress
from edp.recording import Recording
from edp.settings.results import plain_value
from edp.signals import Kind
from edp.sim.machine.machine_files import load_machine
from edp.storage.runs import KeyedRun, Run, check_claimable, run_key
from edp.training.blas import one_blas_thread
from edp.training.provenance import training_provenance
from edp.training.twin_bundle import OIL_C, STROKES, TwinBundle, load_twin, save_twin
from edp.workflows.twin.choose_twin import TwinChoice
from edp.workflows.twin.continue_twin import BaseTwin, ContinuedTwin
from edp.workflows.twin.fit_twin import FittedFormulation, TwinFit
from edp.workflows.twin.ground_twin import ground_twin
from edp.workflows.twin.judge_twin import judge_twin, write_scores
from edp.workflows.twin.prepare_twin import cut_recordings, driving_labels, prepare_twin

FOLDER = "twin"


@dataclass(frozen=True, eq=False)
class TrainedTwin:
    """Result of `train_twin`.

    Attributes:
        bundle: the twin on disk.
        scores: scores of the twin and of every reference, by label: see `edp.evaluation.free_run.free_run_scores`.
        resumed: whether it was finished before, and only read.
    """

    bundle: TwinBundle
    scores: Mapping[str, FreeRunScores]
    resumed: bool


@one_blas_thread()
def train_twin(
    source: DataSource,
    experiment: TwinExperiment,
    out: str | Path,
    progress: Progress = SILENT,
    workers: Workers = IN_PROCESS,
    start: str | Path | None = None,
) -> TrainedTwin:
    """Train a twin and write a run folder, or read a finished one, or continue an interrupted one.

    The folder holds ``twin/``, settings, history and ``free_run.json``, and ``candidates.json`` if several formulations
    were fitted.

    Args:
        source: source of the recordings.
        experiment: the settings.
        out: run folder.
        progress: receiver of what begins; the units of a training are updates.
        workers: who trains the networks of an average; nodes see the run folder under the same path. The twin has the
            same bits with any number.
        start: run folder of a recurrent twin that goes on with these recordings, or with a `ground` of a grey box
            that learns it from them; None: a new one.

    Raises:
        EdpError: the recordings, settings or folder cannot be used; what was on disk stays.
    """
    check_claimable(out, "twin")
    if experiment.ground:
        grounded, finished = ground_twin(source, experiment, out, start, progress)
        return TrainedTwin(grounded, read_models(grounded.scores, f"'{out}'"), finished)
    progress.note("reading recordings")
    base = None if start is None else BaseTwin.from_run(start)
    if base is not None:
        experiment = base.settled(experiment)
    recordings = source.read()
    channels, data = cut_recordings(recordings, experiment)
    labels, begun = driving_labels(recordings), {}
    if base is not None:
        base.check(channels, data.train)
        begun = {"from": base.digest}
    _check_judged(channels, data, experiment, base)
    # Runs of versions that knew no ground are the same ones.
    settings = {name: value for name, value in TWIN_SETTINGS.to_dict(experiment).items() if name != "ground"}
    key = run_key({"twin": settings} | begun | _linkage(experiment), data.digest)
    create = Run.create(out, "twin", key, twin_toml(experiment))
    with create as run, workers.stay() as staying:
        if run.is_finished:
            bundle = load_twin(run.path)
            return TrainedTwin(bundle, read_models(bundle.scores, f"'{run.path}'"), True)
        fit = TwinFit(channels, fit_scales(channels, data.train), data, experiment, progress, staying)
        result = _train_or_choose(fit, KeyedRun(run, key), base)
        fitted = result.fitted
        run.write_history(fitted.history)
        if fitted.datasheet:
            Datasheet(basis=BASIS, numbers=fitted.datasheet).write(run.path)
        progress.note("calibrating intervals")
        intervals = calibrated(result.unseen or ((fitted.twin, data.validation),), experiment.evaluation)
        before = None if base is None else base.bundle.provenance.more.get(RANGES)
        ranges = command_ranges(channels, [*data.train, *data.validation], before)
        provenance = training_provenance(source, data, experiment.training.seed, 1, fitted.seconds).add_entries(
            **_full_strokes(recordings), **_oil(recordings), **fitted.facts, **{RANGES: ranges}
        )
        bundle = TwinBundle(result.spec, fitted.twin, provenance, {}, intervals)
        scores, runs = judge_twin(bundle, experiment, data, labels, progress)
        write_scores(run.path, scores, runs, intervals)
        step_responses(bundle.twin, data.test).write(run.path)
        bundle = replace(bundle, scores=plain_value(scores))
        save_twin(bundle, run.file(FOLDER))
    return TrainedTwin(bundle, scores, False)


def _check_judged(channels: TwinChannels, data: Prepared, experiment: TwinExperiment, base: BaseTwin | None) -> None:
    """Raise an error if the new twin could not be evaluated on these recordings, before it is trained.

    Raises:
        DataError: see `check_runs`.
    """
    judge, prefix = experiment.evaluation, experiment.twin.prefix_ticks
    # An automatic twin is fitted to both parts in the end, and calibrated on folds of them.
    auto = isinstance(experiment.twin, AutoTwin)
    scales = fit_scales(channels, [*data.train, *data.validation] if auto else data.train)
    scales = scales if base is None else scales_for(base.twin, scales, data.train)
    # The end stops of a motor are free, see `turning_scales`.
    turns = [channel.kind is not Kind.POSITION for channel in channels.strokes]
    columns = len(channels.velocities) + np.flatnonzero(turns)
    low, high = scales.low.copy(), scales.high.copy()
    low[columns], high[columns] = -FARTHEST_TURN, FARTHEST_TURN
    scales = replace(scales, low=low, high=high)
    check_runs(channels, scales, prefix, data.test, judge.duration_s, judge.starts)
    if not auto:
        check_runs(channels, scales, prefix, data.validation, judge.duration_s, judge.calibration_starts)


def _linkage(experiment: TwinExperiment) -> dict[str, object]:
    """Return all parameters of the linkage's machine file, so that an edited file requires a new twin.

    Raises:
        ConfigError: no such machine.
    """
    spec = experiment.twin
    if not isinstance(spec, GreyBox) or not spec.linkage:
        return {}
    return {"linkage": asdict(load_machine(spec.linkage))}


def _train_or_choose(fit: TwinFit, run: KeyedRun, base: BaseTwin | None) -> FittedFormulation:
    """Return the twin of the settings, or the fine-tuned twin; write a choice to ``candidates.json``."""
    spec = fit.experiment.twin
    if base is not None:
        result, tried = ContinuedTwin(fit, base, run).best()
        CandidatesFile(candidates=tuple(one.row() for one in tried)).write(run.folder.path)
        return result
    if not isinstance(spec, AutoTwin):
        result = fit.fitted(spec, run)
        return result if result.fitted.history else fit.refitted(result)
    result, tried = TwinChoice(fit, spec, run).best()
    CandidatesFile(candidates=tuple(one.row() for one in tried)).write(run.folder.path)
    return result


def _oil(recordings: Sequence[Recording]) -> dict[str, object]:
    """Return the oil temperature if all recordings state it."""
    celsius = np.concatenate([oil_celsius(recording) for recording in recordings])
    return {OIL_C: float(celsius.mean())} if np.isfinite(celsius).all() else {}


def _full_strokes(recordings: Sequence[Recording]) -> dict[str, object]:
    """Return the full strokes (m) of the machine, if simulated recordings agree on them."""
    stated = [recording.meta[STROKES] for recording in recordings if STROKES in recording.meta]
    # A log may say anything; what is no list of numbers says nothing.
    if not stated or not all(_numbers(each) and each == stated[0] for each in stated):
        return {}
    return {STROKES: stated[0]}


def _numbers(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(each, int | float) for each in value)


__all__ = ["FOLDER", "TrainedTwin", "prepare_twin", "train_twin"]
