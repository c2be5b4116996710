"""Run of a twin along a log: measured up to a moment, free on the commands afterwards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from edp.data.derived_velocities import matched
from edp.errors import ConfigError, DataError, count_of
from edp.evaluation.beyond import RANGES, commands_beyond
from edp.evaluation.free_run import MAX_SECONDS, FreeRunJudgeSpec, free_run_scores, runs_of
from edp.evaluation.free_run_file import TWIN, CommandExcess, FreeRunFile, FreeRunScores
from edp.logs import write_recording
from edp.logs.as_before import read_as_before
from edp.logs.source import DataSource
from edp.networks.twin import Twin
from edp.recording import Recording
from edp.report import FreeRunFacts, build_twin_page, write_rollout_plots
from edp.settings.bounds import above, span
from edp.signals import Channel
from edp.training.twin_bundle import load_twin
from edp.wording import setting_text, typed
from edp.workflows.twin.judge_twin import describe_channels, select_shown_runs
from edp.workflows.twin.prepare_twin import answer_columns

FREE = "_twin"
"""Behind the name of a channel, for what the twin answered in its place."""
LOW, HIGH = f"{FREE}_low", f"{FREE}_high"
"""Behind the name of a channel, for the ends of the interval of that output."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """Free run with the measured values.

    Attributes:
        recording: commands, measured channels, and the twin's outputs under names that end in `FREE`, with their
            intervals under `LOW` and `HIGH`; row by row at the same time.
        scores: see `edp.evaluation.free_run.free_run_scores`.
        start_s: start of the free run in the log, s.
        coverage: share that the intervals are meant to hold; None without intervals.
        calibrated_s: length of a free run up to which they are calibrated; beyond it they stay as wide.
        beyond: commands of the free run beyond those that taught the twin, see `edp.evaluation.beyond`.
    """

    recording: Recording
    scores: FreeRunScores
    start_s: float
    coverage: float | None
    calibrated_s: float | None
    beyond: Mapping[str, CommandExcess]


@dataclass(frozen=True, kw_only=True)
class RolloutRequest:
    """Part of a log that a twin runs along, and files of the result.

    Attributes:
        seconds: length of the free run.
        start_s: its start in the log; None: as early as the prefix allows.
        measured: channels that stay measured throughout (mixed mode).
        out: file for `Rollout.recording`; its ending chooses the format.
        plots: folder for plots of it.
        page: file for a page of it (HTML).
    """

    seconds: float = 60.0
    start_s: float | None = None
    measured: Sequence[str] = ()
    out: str | Path | None = None
    plots: str | Path | None = None
    page: str | Path | None = None


def rollout_log(run: str | Path, source: DataSource, request: RolloutRequest) -> Rollout:
    """Simulate the twin of a run along the commands of a log.

    Args:
        run: run folder of a twin.
        source: one log; without a map it is read with that of the run.
        request: part of the log, and files to write.

    Raises:
        EdpError: several logs, another rate or kind, times outside the log, or a channel that the twin does not output.
    """
    bundle = load_twin(run)
    twin = bundle.twin
    recording = matched(twin.channels, _only(read_as_before(source, bundle.provenance.origin.reader).read()))
    measured_columns = answer_columns(twin, request.measured, "--measured")
    series = twin.channels.task().series(recording)
    start, ticks = _span(twin, recording, request.seconds, request.start_s)
    first = start - twin.prefix_ticks
    commands, truth = series.inputs[None, first : start + ticks], series.targets[None, first : start + ticks + 1]
    prefix = twin.prefix_ticks
    ports = np.full_like(truth[:, prefix:-1], np.nan)
    for column in measured_columns:
        ports[..., column] = truth[:, prefix:-1, column]
    state = twin.reset(commands[:, :prefix], truth[:, :prefix])
    answers, _ = twin.rollout(commands[:, prefix:], state, ports)
    runs = runs_of(twin, (recording.name,), answers, truth[:, prefix:])
    spec = FreeRunJudgeSpec()
    at_s = sorted({*(at for at in spec.at_s if at < request.seconds), ticks / twin.channels.rate_hz})
    # Intervals are calibrated on runs in which every port is free; a measured one would make them wrong, not narrow.
    intervals = None if measured_columns else bundle.intervals
    half = None if intervals is None else intervals.at(np.arange(1, ticks + 1)).astype(np.float32)
    result = Rollout(
        _make_recording(twin, recording, answers[0], half, start),
        free_run_scores(runs, replace(spec, at_s=tuple(at_s)), intervals),
        start / recording.rate_hz,
        None if intervals is None else intervals.coverage,
        None if intervals is None else intervals.ticks[-1] / recording.rate_hz,
        commands_beyond(bundle.provenance.more.get(RANGES), twin.channels, [commands[0, prefix:]]),
    )
    if request.out is not None:
        write_recording(result.recording, request.out)
    if request.plots is not None:
        write_rollout_plots(result.recording, FREE, (start + 1) / recording.rate_hz, request.plots)
    if request.page is not None:
        content = FreeRunFile(channels=describe_channels(twin.channels), models={TWIN: result.scores})
        title = f"{recording.name} from {typed(result.start_s)} s"
        build_twin_page(FreeRunFacts(title, content, select_shown_runs(runs, intervals))).write(request.page)
    return result


def _only(recordings: Sequence[Recording]) -> Recording:
    if len(recordings) != 1:
        names = ", ".join(recording.name for recording in recordings[:5])
        raise DataError(f"{count_of(len(recordings), 'recording')} came ({names}); a twin runs along one: give one log")
    return recordings[0]


def _span(twin: Twin, recording: Recording, seconds: float, start_s: float | None) -> tuple[int, int]:
    """Return the first tick of a free run and its length, which both lie in the log."""
    rate, prefix = recording.rate_hz, twin.prefix_ticks
    if not above(0.0, MAX_SECONDS).holds(seconds):
        rule = above(0.0, MAX_SECONDS).rule("rollout_seconds")
        raise ConfigError(f"--rollout-seconds {setting_text(seconds)}: {rule} must hold")
    if start_s is not None and not span(0.0, MAX_SECONDS).holds(start_s):
        raise ConfigError(f"--from {setting_text(start_s)}: {span(0.0, MAX_SECONDS).rule('from')} must hold")
    start = prefix if start_s is None else round(start_s * rate)
    ticks = max(1, round(seconds * rate))
    if recording.samples < prefix + 2:
        raise DataError(
            f"'{recording.name}' has {recording.samples} ticks ({typed(recording.duration_s)} s); the twin needs a "
            "prefix "
            f"of {prefix} measured ones ({typed(prefix / rate)} s) and two more: give a longer log"
        )
    if start < prefix:
        raise DataError(
            f"a free run from {typed(start / rate)} s has {start} measured ticks before it; the twin needs a prefix "
            "of "
            f"{prefix} ({typed(prefix / rate)} s): begin at --from {setting_text(prefix / rate)} or later"
        )
    # One more row than answers: the last answer is compared with the tick after the last command.
    if start + ticks + 1 > recording.samples:
        longest = (recording.samples - 1 - start) / rate
        room = f"at most --rollout-seconds {setting_text(longest)} from there" if longest > 0 else "begin earlier"
        raise DataError(
            f"a free run of {typed(seconds)} s from {typed(start / rate)} s goes beyond the end of "
            f"'{recording.name}' at "
            f"{typed(recording.duration_s)} s; {room}"
        )
    return start, ticks


def _make_recording(
    twin: Twin, recording: Recording, answers: np.ndarray, half: np.ndarray | None, start: int
) -> Recording:
    """Return a recording; row t holds commands, measurements, outputs and intervals of tick start + 1 + t."""
    channels = twin.channels.commands + twin.channels.answers
    rows = slice(start + 1, start + 1 + len(answers))
    measured_values = recording.select([channel.name for channel in channels])[rows]
    columns, own = [measured_values, answers], _rename_channels(twin, FREE, "free run")
    if half is not None:
        own += _rename_channels(twin, LOW, "free run, lower end") + _rename_channels(twin, HIGH, "free run, upper end")
        columns += [answers - half, answers + half]
    return Recording(
        f"{recording.name}_rollout",
        channels + own,
        np.ascontiguousarray(np.concatenate(columns, axis=1)),
        recording.rate_hz,
        recording.source,
        {"start_s": (start + 1) / recording.rate_hz},
    )


def _rename_channels(twin: Twin, suffix: str, text: str) -> tuple[Channel, ...]:
    """Return the channels of the outputs under other names."""
    return tuple(
        replace(channel, name=f"{channel.name}{suffix}", description=f"{channel.description} ({text})".strip())
        for channel in twin.channels.answers
    )
