"""Logs with forecasts of a twin as additional channels, which networks read like measured ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from edp.data.derived_velocities import matched
from edp.errors import ConfigError, DataError
from edp.evaluation.free_run_file import ChannelErrors
from edp.evaluation.free_run_parts import by_channel
from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.networks.twin import Twin
from edp.networks.twin.forecast import CHOICE_LOGS, check_gain, check_horizons, choose_gain, forecast
from edp.progress import SILENT, Progress
from edp.recording import Recording
from edp.report.common.picture import file_name
from edp.signals import Channel
from edp.storage import replacing_folder
from edp.storage.paths import entries_of, is_folder_at, is_there
from edp.training.twin_bundle import TwinBundle, load_twin
from edp.wording import typed
from edp.workflows.twin.prepare_twin import answer_columns

AHEAD = "_in_"
"""Between the name of an output and the ticks ahead, in the name of a forecast."""


@dataclass(frozen=True, kw_only=True)
class ForecastErrors:
    """Mean absolute errors of forecasts at one horizon, and of the present value as forecast.

    Attributes:
        ticks: horizon in samples.
        seconds: the horizon in seconds.
        moments: number of samples.
    """

    ticks: int
    seconds: float
    moments: int
    twin: ChannelErrors
    persistence: ChannelErrors


@dataclass(frozen=True, eq=False)
class ForecastLogs:
    """Written logs, and the errors of their forecasts.

    Attributes:
        files: a log each.
        channels: names of the forecasts.
        gain: gain of the observer.
        scores: scores by horizon as text.
    """

    files: tuple[Path, ...]
    channels: tuple[str, ...]
    gain: float
    scores: Mapping[str, ForecastErrors]


def forecast_logs(
    run: str | Path,
    source: DataSource,
    horizons: Sequence[int],
    out: str | Path,
    answers: Sequence[str] = (),
    gain: float | None = None,
    progress: Progress = SILENT,
) -> ForecastLogs:
    """Write logs again with a channel for each forecast of a twin: ``CylVels_1_in_10`` is CylVels_1 in ten ticks.

    In the first ticks of a log, before the observer has settled, a forecast is the present value.

    Args:
        run: run folder of a twin.
        source: the logs.
        horizons: ticks ahead.
        out: folder of the new logs (Parquet), which are there all together or not at all; it must not hold anything
            yet.
        answers: outputs to predict; empty for the velocities.
        gain: gain of the observer; None to choose it on the training logs of the twin, if they are among these,
            otherwise on the first logs.
        progress: receiver of the progress; its units are logs.

    Raises:
        EdpError: logs of other channels or another rate, a channel that the twin does not output, or a folder in use.
    """
    check_horizons(horizons)
    if gain is not None:
        check_gain(gain)
    bundle = load_twin(run)
    twin = bundle.twin
    velocities = [channel.name for channel in twin.channels.velocities]
    columns = answer_columns(twin, list(dict.fromkeys(answers or velocities)), "--channel")
    _refuse_used(Path(out))
    recordings = source.read()
    if gain is None:
        gain = _choose_gain(bundle, recordings, horizons)
    names, errors, logs = [], [], progress.stage("log", len(recordings))
    with replacing_folder(out) as folder:
        for number, logged in enumerate(recordings, start=1):
            logs.note(logged.name)
            recording = _check_recording(twin, logged)
            values, measured, settled = _forecasts(twin, recording, horizons, columns, gain)
            errors.append(_errors(values, measured, horizons, settled))
            extended = _add_forecasts(twin, recording, values, horizons, columns)
            # The name comes from a file: as it is, it could be a path out of the folder, or that of another log.
            names.append(f"{number:04d}_{file_name(recording.name)}.parquet")
            write_recording(extended, folder / names[-1])
            logs.step(number)
    channels = tuple(channel.name for channel in _channels(twin, horizons, columns))
    files = tuple(Path(out) / name for name in names)
    return ForecastLogs(files, channels, gain, _scores(twin, errors, horizons, columns))


def _choose_gain(bundle: TwinBundle, recordings: Sequence[Recording], horizons: Sequence[int]) -> float:
    """Choose a gain on the twin's training logs, or on the first logs if they contain no training log."""
    learned_names = bundle.provenance.recording_names("train", "validation")
    chosen = [logged for logged in recordings if logged.name in learned_names] or list(recordings)
    task = bundle.twin.channels.task()
    series = [task.series(_check_recording(bundle.twin, logged)) for logged in chosen[:CHOICE_LOGS]]
    return choose_gain(bundle.twin, series, horizons)


def _refuse_used(folder: Path) -> None:
    """Check before the work that no file will be lost."""
    if is_there(folder) and (not is_folder_at(folder) or any(entries_of(folder))):
        raise ConfigError(f"--out '{folder}' holds something already; name a folder that is new or empty")


def _check_recording(twin: Twin, logged: Recording) -> Recording:
    if logged.rate_hz != twin.channels.rate_hz:
        raise DataError(
            f"recording '{logged.name}' has {typed(logged.rate_hz)} Hz, the twin {typed(twin.channels.rate_hz)} Hz; "
            "train a twin "
            "on logs of this rate"
        )
    return matched(twin.channels, logged)


def _forecasts(
    twin: Twin, recording: Recording, horizons: Sequence[int], columns: list[int], gain: float
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return forecasts ``(tick, horizon, column)``, measurements ``(tick, column)``, first forecast tick."""
    commands, measured = (
        np.ascontiguousarray(recording.select([channel.name for channel in part]))
        for part in (twin.channels.commands, twin.channels.answers)
    )
    try:
        values = forecast(twin, commands, measured, horizons, gain)[..., columns]
    except DataError as error:
        raise DataError(f"recording '{recording.name}': {error}") from error
    present = measured[:, columns]
    # A network that trains on the log reads a number at every tick; nothing better than the present value is known.
    unsettled = np.isnan(values[:, 0, 0])
    settled = len(values) if unsettled.all() else int(np.argmin(unsettled))
    values[:settled] = present[:settled, None]
    return values, present, settled


def _channels(twin: Twin, horizons: Sequence[int], columns: list[int]) -> list[Channel]:
    rate, described = twin.channels.rate_hz, []
    for k in horizons:
        for column in columns:
            answer = twin.channels.answers[column]
            text = f"{answer.name} in {typed(k / rate)} s, as a twin forecasts it with the commands held"
            described.append(Channel(f"{answer.name}{AHEAD}{k}", answer.kind, text))
    return described


def _add_forecasts(
    twin: Twin, recording: Recording, values: np.ndarray, horizons: Sequence[int], columns: list[int]
) -> Recording:
    """Return the recording with its forecasts after its own channels."""
    added = _channels(twin, horizons, columns)
    doubled = [channel.name for channel in added if channel.name in recording.channel_names]
    if doubled:
        raise DataError(
            f"recording '{recording.name}' ({recording.source}) has a channel '{doubled[0]}' already; give the logs as "
            "they were before they had forecasts"
        )
    whole = np.concatenate([recording.values, values.reshape(len(values), -1)], axis=1, dtype=np.float32)
    return replace(recording, channels=recording.channels + tuple(added), values=whole)


def _errors(
    values: np.ndarray, measured: np.ndarray, horizons: Sequence[int], settled: int
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return sums of absolute errors of forecast and present value for each horizon ``(column,)``, and their count."""
    sums = []
    for at, k in enumerate(horizons):
        last = max(settled, len(values) - k)
        pair = np.stack([values[settled:last, at], measured[settled:last]])
        apart = np.abs(pair - measured[settled + k :]).astype(np.float64)
        finite = np.isfinite(apart).all(axis=0)
        ours, present = np.where(finite, apart, 0.0).sum(axis=1)
        sums.append((ours, present, finite.sum(axis=0)))
    return sums


def _scores(
    twin: Twin,
    errors: list[list[tuple[np.ndarray, np.ndarray, np.ndarray]]],
    horizons: Sequence[int],
    columns: list[int],
) -> dict[str, ForecastErrors]:
    forecast_channels = [twin.channels.answers[column] for column in columns]
    rows = {}
    for at, k in enumerate(horizons):
        ours, present, counted = (sum(each) for each in zip(*(log[at] for log in errors), strict=True))
        own, present_value = (
            by_channel(forecast_channels, np.divide(total, np.maximum(counted, 1))) for total in (ours, present)
        )
        seconds, moments = k / twin.channels.rate_hz, int(np.min(counted))
        rows[str(k)] = ForecastErrors(ticks=k, seconds=seconds, moments=moments, twin=own, persistence=present_value)
    return rows
