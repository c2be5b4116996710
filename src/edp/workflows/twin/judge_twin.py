"""Evaluation of a twin with its baselines, in free run and a few ticks ahead, on held-out recordings or on others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from edp.config.twin import TwinExperiment, load_twin_experiment
from edp.data.derived_velocities import matched
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError, DataError, NotFiniteError
from edp.evaluation.ahead import Ahead, look_ahead, predictor_scores, score_ahead
from edp.evaluation.beyond import RANGES, commands_beyond
from edp.evaluation.free_run import FreeRunJudgeSpec, FreeRuns, free_run_scores, free_runs
from edp.evaluation.free_run_file import (
    RUNS,
    TWIN,
    AheadErrors,
    AnswerChannels,
    FreeRunFile,
    FreeRunScores,
    PredictorComparison,
    ReportedChannel,
)
from edp.evaluation.step_response import step_responses
from edp.logs.as_before import read_as_before
from edp.logs.source import DataSource
from edp.networks.predictor import Predictor, describe
from edp.networks.running import stream_predictions
from edp.networks.twin import TWINS, FreeRunIntervals, Twin, TwinSpec
from edp.progress import SILENT, Progress
from edp.recording import Recording
from edp.signals import KINDS, Channel
from edp.storage import check_writable, make_folder, write_bytes
from edp.storage.headers import digests_of
from edp.training import load_bundle
from edp.training.twin_bundle import TwinBundle, load_twin
from edp.workflows.twin.prepare_twin import cut_recordings, driving_labels

SHOWN_RUNS = 6
"""Free runs on a page: a reader goes through a few."""
SHOWN_TICKS = 1200
"""Points of a line on a page: more than its width resolves."""


def judge_twin(
    bundle: TwinBundle,
    experiment: TwinExperiment,
    data: Prepared,
    labels: Mapping[str, str],
    progress: Progress = SILENT,
) -> tuple[dict[str, FreeRunScores], FreeRuns]:
    """Return the scores of a twin and its baselines on the test part by label, and the twin's free runs.

    Args:
        bundle: the twin.
        experiment: its settings; baselines are fitted to training and validation part, with the same prefix: the twin
            has seen both.
        data: prepared series.
        labels: see `driving_labels`.
        progress: receiver of what begins.
    """
    twin, spec = bundle.twin, experiment.evaluation
    progress.note("free runs of the twin")
    runs = free_runs(twin, data.test, spec.duration_s, spec.starts)
    beyond = commands_beyond(bundle.provenance.more.get(RANGES), twin.channels, [part.inputs for part in data.test])
    own = free_run_scores(runs, spec, bundle.intervals, labels)
    scores = {TWIN: replace(own, ahead=_score_ahead(twin, data, spec), beyond=beyond)}
    for name in spec.baselines:
        progress.note(f"free runs of {name}")
        floor_spec: TwinSpec = replace(TWINS[name](), prefix_ticks=experiment.twin.prefix_ticks)
        taught, seed = [*data.train, *data.validation], experiment.training.seed
        try:
            floor = floor_spec.start(twin.channels, twin.scales, taught, seed)
            floor_runs = free_runs(floor, data.test, spec.duration_s, spec.starts)
        except (ConfigError, DataError, NotFiniteError) as problem:
            # What such a log is too short for is no rival on it, and no reason to have no twin.
            progress.note(f"the floor {name} is left out: {problem}")
            continue
        scores[name] = replace(free_run_scores(floor_runs, spec, None, labels), ahead=_score_ahead(floor, data, spec))
    return scores, runs


def write_scores(
    folder: Path, scores: Mapping[str, FreeRunScores], runs: FreeRuns, intervals: FreeRunIntervals | None
) -> None:
    """Write ``free_run.json`` and the runs that pages draw, ``free_runs.safetensors``.

    Raises:
        StorageError: a file cannot be written.
    """
    write_bytes(folder / RUNS, save(select_shown_runs(runs, intervals)))
    channels = describe_channels(runs.channels)
    FreeRunFile(channels=channels, models=dict(scores), files=digests_of(folder, RUNS)).write(folder)


def describe_channels(channels: TwinChannels) -> AnswerChannels:
    """Return the data of each output for a page."""

    def reported(channel: Channel) -> ReportedChannel:
        kind = KINDS[channel.kind]
        return ReportedChannel(
            name=channel.name, description=channel.description, unit=kind.report_unit, factor=kind.report_factor
        )

    parts = {part: tuple(map(reported, channels.answers[columns])) for part, columns in channels.parts.items()}
    return AnswerChannels(**parts)


def select_shown_runs(runs: FreeRuns, intervals: FreeRunIntervals | None) -> dict[str, NDArray[Any]]:
    """Return a few thinned runs for pages: time, outputs, truth, and half widths if intervals are known.

    One run of each way of driving would need labels; one of each recording, evenly chosen, needs none.
    """
    ticks = runs.truth.shape[1]
    stride = -(-ticks // SHOWN_TICKS)
    at = np.arange(stride - 1, ticks, stride)
    arrays: dict[str, NDArray[Any]] = {"seconds": ((at + 1) / runs.channels.rate_hz).astype(np.float32)}
    if intervals is not None:
        arrays["half_width"] = intervals.at(at + 1).astype(np.float32)
    first = list(dict(zip(reversed(runs.names), reversed(range(len(runs.names))), strict=True)).values())[::-1]
    for which in np.unique(np.linspace(0, len(first) - 1, SHOWN_RUNS).astype(np.int64)):
        run = first[which]
        arrays[f"{runs.names[run]}/answers"] = np.ascontiguousarray(runs.answers[run, at])
        arrays[f"{runs.names[run]}/truth"] = np.ascontiguousarray(runs.truth[run, at])
    return arrays


def _score_ahead(twin: Twin, data: Prepared, spec: FreeRunJudgeSpec) -> AheadErrors | None:
    """Return the scores a few ticks ahead; None where no recording is long enough."""
    longest = max(part.samples for part in data.test)
    if longest < twin.prefix_ticks + spec.horizon + 1:
        return None
    return score_ahead(look_ahead(twin, data.test, spec.horizon))


def evaluate_twin(
    run: str | Path,
    source: DataSource | None = None,
    predictor_run: str | Path | None = None,
    progress: Progress = SILENT,
) -> Path:
    """Evaluate a twin again: on its held-out recordings, or on all of other recordings.

    Args:
        run: run folder of a twin.
        source: other recordings.
        predictor_run: run folder of a look-ahead predictor; its error stands beside the twin's, at the same moments.
        progress: receiver of what begins.

    Returns:
        The folder with ``free_run.json``: the run folder, or one in it for `source`.

    Raises:
        EdpError: no twin, recordings that changed since, or a predictor that predicts nothing that the twin outputs.
    """
    folder = Path(run)
    bundle = load_twin(folder)
    check_writable(folder)
    experiment = load_twin_experiment(folder / "config.toml")
    progress.note("reading recordings")
    recordings = DataSource.from_dict(bundle.provenance.origin.reader).read()
    channels, data = cut_recordings(recordings, experiment)
    if data.digest != bundle.provenance.origin.digest:
        raise DataError(
            f"the recordings in '{bundle.provenance.origin.source}' changed since '{folder}' was trained; the "
            "held-out part would not be the same: train again, or judge other recordings with --data"
        )
    target = folder
    if source is not None:
        source = read_as_before(source, bundle.provenance.origin.reader)
        recordings = [matched(channels, recording) for recording in source.read()]
        data = replace(data, test=[channels.task().series(recording) for recording in recordings])
        target = make_folder(folder / f"on_{source.short_name}")
    scores, runs = judge_twin(bundle, experiment, data, driving_labels(recordings), progress)
    if predictor_run is not None:
        progress.note("the look-ahead predictor")
        beside = compare_with_predictor(bundle.twin, data.test, recordings, Path(predictor_run), experiment.evaluation)
        scores[TWIN] = replace(scores[TWIN], beside=beside)
    write_scores(target, scores, runs, bundle.intervals)
    step_responses(bundle.twin, data.test).write(target)
    return target


def compare_with_predictor(
    twin: Twin, test: Sequence[Series], recordings: Sequence[Recording], run: Path, spec: FreeRunJudgeSpec
) -> PredictorComparison:
    """Return errors of a look-ahead predictor and of the twin at the same moments, for their common channels.

    The twin is told the commands in between; the predictor is not.

    Raises:
        EdpError: no bundle, another rate, or no channel in common.
    """
    bundle = load_bundle(run)
    predictor, task = bundle.predictor, bundle.task
    ticks = spec.horizon if spec.horizon in task.horizons else max(task.horizons)
    names = [name for name in task.targets if name in {channel.name for channel in twin.channels.answers}]
    if ticks < 1 or not names:
        raise DataError(
            f"'{run}' predicts {', '.join(task.targets)} at horizons {', '.join(map(str, task.horizons))}, nothing "
            "ahead that the twin answers; give a predictor of the twin's velocities, strokes or pressures"
        )
    by_recording = {recording.name: recording for recording in recordings}
    pieces = [task.series(*_rows(part.name, by_recording), part.name) for part in test]
    ahead = look_ahead(twin, test, ticks, predictor.spec.window)
    predicted = _predict_at_moments(predictor, pieces, ahead)
    columns = {name: predicted[:, task.targets.index(name)] for name in names}
    # A recording that trained the predictor flatters it: a reader must know.
    trained = bundle.provenance.recording_names("train")
    seen = sorted({part.name for part in test if part.name in trained})
    return PredictorComparison(
        run=str(run),
        label=describe(predictor.spec),
        ticks=ticks,
        trained_on=tuple(seen),
        seconds=ticks / twin.channels.rate_hz,
        moments=len(ahead.truth),
        errors=predictor_scores(ahead, columns),
    )


def _rows(name: str, recordings: Mapping[str, Recording]) -> tuple[Recording, int, int | None]:
    """Return recording and rows of a segment by its name, ``recording`` or ``recording[start:stop]``, see `prepare`."""
    if name in recordings:
        return recordings[name], 0, None
    whole, _, rows = name.removesuffix("]").rpartition("[")
    start, _, stop = rows.partition(":")
    return recordings[whole], int(start), int(stop)


def _predict_at_moments(predictor: Predictor, series: Sequence[Series], ahead: Ahead) -> NDArray[np.float32]:
    """Return the predictions that far ahead at the moments ``(moment, target)``, SI units."""
    which = predictor.task.horizons.index(ahead.ticks)
    predictions = stream_predictions(predictor, series)
    return np.concatenate([p[at, which] for p, at in zip(predictions, ahead.moments, strict=True)])


__all__ = ["compare_with_predictor", "evaluate_twin", "judge_twin", "write_scores"]
