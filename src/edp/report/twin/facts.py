"""Evaluation of a twin as tables, key figures and sentences; kinds of channels stay apart."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from edp.errors import StorageError, count_of
from edp.evaluation.free_run_file import (
    PARTS,
    RUNS,
    TWIN,
    AheadErrors,
    CandidateRow,
    ChannelErrors,
    FreeRunFile,
    FreeRunScores,
    IntervalCoverage,
    PredictorComparison,
    ReportedChannel,
    RunSummary,
    StepResponses,
    StrokeErrors,
)
from edp.evaluation.guard import twin_verdict
from edp.report.twin.candidates import candidate_table, choice_sentence, read_candidates
from edp.settings.provenance import Provenance
from edp.storage import read_object
from edp.storage.headers import check_files
from edp.storage.paths import full_path, is_file_at
from edp.table import Column, Table, Value, figures
from edp.wording import figure, listed, number, percent, short_labels

SITUATIONS = {"end_stops": "at an end stop", "rest": "at rest (idling)", "motion": "in motion"}
MAX_ROWS = 40
"""Maximum number of recordings in a table, the worst first."""
PLAIN_UNIT = "1"


@dataclass(frozen=True, eq=False)
class FreeRunFacts:
    """Content of ``free_run.json`` and of the runs in the same folder.

    Attributes:
        title: title of the page.
        content: content of the file.
        shown: ``seconds``, ``half_width`` where known, and ``NAME/answers``, ``NAME/truth`` ``(tick, output)``, SI.
        provenance: provenance of the twin; empty if unknown.
        candidates: formulations that it was chosen among, see `read_candidates`; empty where it was not chosen.
        steps: responses to steps of its commands, see `read_steps`; None where they are not at hand.
    """

    title: str
    content: FreeRunFile
    shown: Mapping[str, NDArray[np.float32]]
    provenance: Provenance = field(default_factory=Provenance)
    candidates: Sequence[CandidateRow] = ()
    steps: StepResponses | None = None

    @property
    def models(self) -> Mapping[str, FreeRunScores]:
        """Return the scores of the twin, followed by the scores of its baselines."""
        return self.content.models

    @property
    def twin(self) -> FreeRunScores:
        """Scores of the twin."""
        return self.models[TWIN]

    def channels(self, part: str) -> Sequence[ReportedChannel]:
        """Return the channels of a part; `PARTS` lists the parts."""
        channels: Sequence[ReportedChannel] = getattr(self.content.channels, part)
        return channels

    def columns(self, part: str) -> range:
        """Return the columns of a part in arrays of all outputs."""
        first = sum(len(self.channels(earlier)) for earlier in PARTS[: PARTS.index(part)])
        return range(first, first + len(self.channels(part)))

    @property
    def names(self) -> list[str]:
        """Recordings of the runs that are shown."""
        return [key.removesuffix("/truth") for key in self.shown if key.endswith("/truth")]


def holds_free_runs(folder: str | Path) -> bool:
    """Test whether a folder is the run of a twin, or a folder in it with the evaluation of other recordings."""
    return any(is_file_at(Path(folder) / name) for name in (FreeRunFile.NAME, "twin/twin.json"))


def read_free_runs(folder: str | Path) -> FreeRunFacts:
    """Read the result of `edp twin` or `edp evaluate` from a run folder, or from a folder in it.

    Raises:
        StorageError: nothing, something of another version, or damaged content.
    """
    path = Path(folder)
    if not is_file_at(path / FreeRunFile.NAME):
        raise StorageError(f"'{folder}' holds no {FreeRunFile.NAME}; run edp evaluate {folder}")
    content = FreeRunFile.read(path)
    check_files(content.files, path, f"run edp evaluate {folder}")
    try:
        shown = load_file(path / RUNS)
    except (OSError, SafetensorError) as error:
        raise StorageError(f"cannot read '{path / RUNS}' ({error}); run edp evaluate {folder}") from error
    header = path / "twin" / "twin.json"
    stated = read_object(header).get("provenance") if is_file_at(header) else {}
    origin = Provenance.from_table(stated if isinstance(stated, dict) else {}, f"'{header}', provenance")
    facts = FreeRunFacts(full_path(path).name, content, shown, origin, read_candidates(path), read_steps(path))
    _check_arrays(facts, path / RUNS)
    return facts


def _check_arrays(facts: FreeRunFacts, path: Path) -> None:
    """Refuse arrays that do not fit the channels or one another."""
    ticks = facts.shown["seconds"].shape[0] if facts.shown.get("seconds", np.zeros(())).ndim == 1 else -1
    expected = (ticks, sum(len(facts.channels(part)) for part in PARTS))
    wrong = [name for name, values in facts.shown.items() if name != "seconds" and values.shape != expected]
    wrong += [] if ticks > 1 else ["seconds"]
    wrong += [f"{name}/answers" for name in facts.names if f"{name}/answers" not in facts.shown]
    if wrong:
        raise StorageError(f"'{path}' does not fit its scores: '{wrong[0][:80]}'; run edp evaluate again")


def read_steps(folder: Path) -> StepResponses | None:
    """Return what `edp twin` or `edp evaluate` wrote of step responses; None for a run of an older version.

    Raises:
        StorageError: damaged content.
    """
    return StepResponses.read(folder) if is_file_at(folder / StepResponses.NAME) else None


def headline(facts: FreeRunFacts) -> str:
    """State the error of the strokes at the end of the runs; of the outputs if they have no unit."""
    judged = twin_verdict(facts.models)
    figures = _figures(facts)
    return figures if judged is None else judged.headline(figures)


def _figures(facts: FreeRunFacts) -> str:
    twin = facts.twin
    plain = _plain_answers(facts)
    if plain:
        off = number(twin.velocity_mae.mean)
        return f"{plain} off by {off} on average in {figure(twin.seconds)} s on commands alone"
    last = twin.stroke_error[-1] if twin.stroke_error else None
    if last is None or last.mean is None:
        return f"{count_of(twin.runs, 'free run')} of {figure(twin.seconds)} s on commands alone"
    return f"Strokes off by {number(last.mean)} {last.unit} after {figure(last.at_s)} s on commands alone"


def _plain_answers(facts: FreeRunFacts) -> str:
    """Return the names of outputs without a unit, whose integral is not a stroke; empty if outputs have units."""
    if facts.twin.velocity_mae.unit != PLAIN_UNIT or facts.twin.velocity_mae.mean is None:
        return ""
    return listed(short_labels(channel.name for channel in facts.channels("velocities")))


def verdict(facts: FreeRunFacts) -> list[str]:
    """Describe the runs and the errors of the baselines."""
    twin = facts.twin
    lines = [
        f"{count_of(twin.runs, 'free run')} of {figure(twin.seconds)} s in "
        f"{count_of(twin.recordings, 'recording')} that trained nothing."
        if facts.provenance != Provenance()
        else f"{count_of(twin.runs, 'free run')} of {figure(twin.seconds)} s."
    ]
    lines += [f"It is {sentence}" for sentence in (choice_sentence(facts.candidates),) if sentence]
    ground = ground_line(facts.provenance)
    lines += [f"It stands on a {ground}; free runs and errors of this page are in free air."] if ground else []
    plain = _plain_answers(facts)
    for name, scores in facts.models.items():
        if name != TWIN and plain:
            lines.append(f"The floor {name} is off by {number(scores.velocity_mae.mean)}.")
        elif name != TWIN and scores.stroke_error and scores.stroke_error[-1].mean is not None:
            last = scores.stroke_error[-1]
            lines.append(f"The floor {name} is off by {number(last.mean)} {last.unit} then.")
    return lines


def ground_line(provenance: Provenance) -> str:
    """State the law of the ground and the error that it explains; empty for a twin of free air.

    Args:
        provenance: provenance of the run; entries in another form are ignored.
    """
    facts = provenance.more.get("ground")
    if not isinstance(facts, Mapping):
        return ""
    explained, kind = facts.get("explained"), facts.get("kind")
    parts = explained.items() if isinstance(explained, Mapping) else ()
    shares = [f"{percent(x)} ({part})" for part, x in parts if isinstance(x, float) and math.isfinite(x)]
    name = f"ground '{kind}'" if isinstance(kind, str) else "ground"
    what = listed(shares) or "nothing"
    return f"{name}: explains {what} of the squares of the forces where the tip touches the ground"


def tiles(facts: FreeRunFacts) -> list[tuple[str, str, str]]:
    """Return key figures: value, unit, description."""
    twin = facts.twin
    velocity = twin.velocity_mae
    if has_mixed_units(twin):
        rows = actuator_tiles(twin)
    else:
        rows = [(number(velocity.mean), velocity.unit or "", "mean absolute error of the velocities")]
        rows += [
            (number(row.mean), row.unit or "", f"stroke error after {figure(row.at_s)} s")
            for row in (*twin.stroke_error[:1], *twin.stroke_error[-1:])
        ]
    if twin.pressure_nrmse.by_channel:
        rows.append((number(twin.pressure_nrmse.mean), "", "error of the pressures in their deviations (NRMSE)"))
    rows.append((percent(twin.diverged), "", "of the runs diverged"))
    intervals = twin.intervals
    if intervals is not None and intervals.at:
        shares = [part.share for row in intervals.at for part in row.parts().values()]
        meant = f"of the truth in intervals meant for {percent(intervals.coverage)}"
        rows.append((" to ".join(dict.fromkeys(map(percent, (min(shares), max(shares))))), "", meant))
    return rows


def free_run_tables(facts: FreeRunFacts) -> dict[str, Table]:
    """Return all tables with content, by name."""
    twin = facts.twin
    tables = [
        *([actuator_table(facts.models)] if has_mixed_units(twin) else []),
        _summary_table("models", "The twin and its floors", "Model", facts.models, frozenset({0})),
        _summary_table("recordings", "By recording, the worst first", "Recording", _worst(twin.by_recording)),
        _summary_table("driving", "By way of driving", "Way of driving", twin.by_driving),
        _situation_table(twin),
        *([candidate_table(facts.candidates)] if facts.candidates else []),
        *([] if twin.intervals is None else [_coverage_table(twin.intervals)]),
        *([] if twin.ahead is None else [_tabulate_ahead(facts, twin.ahead)]),
        *([] if twin.beside is None else [_tabulate_comparison(twin.beside)]),
    ]
    return {table.name: table for table in tables if table.rows}


def _worst(summaries: Mapping[str, RunSummary]) -> dict[str, RunSummary]:
    """Return the recordings sorted by error, largest first: final stroke error, or velocity error without strokes."""

    def size(summary: RunSummary) -> float:
        last: ChannelErrors = summary.stroke_error[-1] if summary.stroke_error else summary.velocity_mae
        if last.mean is not None:
            return last.mean
        return max((value or 0.0 for value in last.by_channel.values()), default=0.0)

    ranked = sorted(summaries.items(), key=lambda entry: -size(entry[1]))
    return dict(ranked[:MAX_ROWS])


def _summary_table(
    name: str,
    caption: str,
    first: str,
    summaries: Mapping[str, RunSummary | FreeRunScores],
    marked: frozenset[int] = frozenset(),
) -> Table:
    """Return one row of errors for each of several sets of runs."""
    rows: list[tuple[Value, ...]] = []
    heads: list[tuple[str, str]] = []
    for label, entry in summaries.items():
        strokes = entry.stroke_error
        heads = [(f"Stroke after {figure(row.at_s)} s", row.unit or "") for row in strokes]
        velocity = entry.velocity_mae
        cells = (velocity.mean, *(row.mean for row in strokes), entry.pressure_nrmse.mean)
        rows.append((label, entry.runs, *cells, percent(entry.diverged)))
    unit = next((entry.velocity_mae.unit for entry in summaries.values()), None) or ""
    titles = [("Velocity MAE", unit), *heads, ("Pressure NRMSE", "")]
    # Nothing is known of a column where units differ, or without pressures.
    full = [i for i in range(len(titles)) if any(row[2 + i] is not None for row in rows)]
    rows = [(*row[:2], *(row[2 + i] for i in full), row[-1]) for row in rows]
    titles = [titles[i] for i in full]
    shown = [Column(title, u, figures(row[2 + i] for row in rows)) for i, (title, u) in enumerate(titles)]
    count = Column("Runs", "", figures([], decimals=0))
    return Table(caption, (Column(first), count, *shown, Column("Diverged")), tuple(rows), marked, name=name)


def _situation_table(twin: FreeRunScores) -> Table:
    rows: list[tuple[Value, ...]] = []
    for name, row in twin.situations.items():
        strokes = None if row.stroke_error is None else row.stroke_error.mean
        cells = (row.velocity_mae.mean, strokes, row.pressure_nrmse.mean)
        rows.append((SITUATIONS.get(name, name), percent(row.share), *cells))
    velocity = next((r.velocity_mae.unit for r in twin.situations.values() if r.velocity_mae.unit), "")
    stroke = next((r.stroke_error.unit for r in twin.situations.values() if r.stroke_error), "") or ""
    titles = [("Velocity MAE", velocity), ("Stroke error", stroke), ("Pressure NRMSE", "")]
    shown = [Column(title, unit, figures(row[2 + i] for row in rows)) for i, (title, unit) in enumerate(titles)]
    heads = (Column("What the actuator did"), Column("Share of the time"), *shown)
    return Table("At end stops, at rest and in motion", heads, tuple(rows), name="situations")


def _coverage_table(intervals: IntervalCoverage) -> Table:
    covered = [(row.at_s, row.parts()) for row in intervals.at]
    parts = list(covered[0][1]) if covered else []
    rows: list[tuple[Value, ...]] = []
    heads: list[Column] = [Column("After")]
    for part in parts:
        unit = covered[0][1][part].half_width.unit or ""
        widths = figures(row[part].half_width.mean for _, row in covered)
        heads += [Column(f"{part.capitalize()} inside"), Column("half width", unit, widths)]
    for at_s, row in covered:
        cells = [cell for part in parts for cell in (percent(row[part].share), row[part].half_width.mean)]
        rows.append((f"{figure(at_s)} s", *cells))
    caption = f"Share of the free runs whose truth lies in intervals meant to hold {percent(intervals.coverage)}"
    return Table(caption, tuple(heads), tuple(rows), name="intervals")


def _tabulate_ahead(facts: FreeRunFacts, first: AheadErrors) -> Table:
    caption = f"{figure(first.seconds)} s ahead of measured ports, told the commands in between"
    if has_mixed_units(facts.twin):
        return tabulate_ahead_by_actuator(facts.models, caption)
    rows: list[tuple[Value, ...]] = []
    for name, scores in facts.models.items():
        ahead = scores.ahead
        if ahead is not None:
            rows.append((name, ahead.velocity_mae.mean, ahead.stroke_error.mean, ahead.pressure_nrmse.mean))
    units = (first.velocity_mae.unit or "", first.stroke_error.unit or "", "")
    titles = ("Velocity MAE", "Stroke error", "Pressure NRMSE")
    shown = [Column(t, u, figures(r[1 + i] for r in rows)) for i, (t, u) in enumerate(zip(titles, units, strict=True))]
    return Table(caption, (Column("Model"), *shown), tuple(rows), frozenset({0}), name="ahead")


def _tabulate_comparison(beside: PredictorComparison) -> Table:
    rows: list[tuple[Value, ...]] = [
        (part, row.twin.unit, row.twin.mean, row.predictor.mean) for part, row in beside.errors.items()
    ]
    both = figures(value for row in rows for value in row[2:])
    heads = (
        Column("MAE of"),
        Column("Unit"),
        Column("Twin, told the commands", "", both),
        Column(beside.label, "", both),
    )
    caption = f"Beside a look-ahead predictor, {figure(beside.seconds)} s ahead at the same {beside.moments:,} moments"
    return Table(caption, heads, tuple(rows), name="beside")


def has_mixed_units(scores: FreeRunScores) -> bool:
    """Return whether velocities of a twin have more than one unit."""
    return bool(scores.velocity_mae.units)


def actuator_table(models: Mapping[str, FreeRunScores]) -> Table:
    """Return one row for each actuator and model: errors of velocity, and of stroke by time, with units."""
    columns = {
        name: [
            ("Velocity MAE", one.velocity_mae),
            *((f"Stroke after {figure(row.at_s)} s", row) for row in one.stroke_error),
        ]
        for name, one in models.items()
    }
    return _tabulate_actuators("actuators", "The twin and its floors, each actuator in its units", columns)


def tabulate_ahead_by_actuator(models: Mapping[str, FreeRunScores], caption: str) -> Table:
    """Return the errors a few ticks ahead of measured ports, one row for each actuator and model."""
    columns = {
        name: [("Velocity MAE", one.ahead.velocity_mae), ("Stroke error", one.ahead.stroke_error)]
        for name, one in models.items()
        if one.ahead is not None
    }
    return _tabulate_actuators("ahead", caption, columns)


def _tabulate_actuators(name: str, caption: str, columns: Mapping[str, Sequence[tuple[str, ChannelErrors]]]) -> Table:
    """Return the rows by actuator, then model; of each model titles and rows of errors, each by channel."""
    first = next(iter(columns.values()))
    rows: list[tuple[Value, ...]] = []
    for which, velocity in enumerate(first[0][1].by_channel):
        for model, entries in columns.items():
            cells = []
            for _, row in entries:
                if row.by_channel:
                    channel, value = list(row.by_channel.items())[which]
                    cells.append(f"{number(value)} {row.unit_of(channel)}".strip())
            rows.append((velocity, model, *cells))
    titles = [title for title, row in first if row.by_channel]
    heads = tuple(Column(title) for title in ("Actuator", "Model", *titles))
    return Table(caption, heads, tuple(rows), frozenset(range(0, len(rows), len(columns))), name=name)


def actuator_tiles(twin: FreeRunScores) -> list[tuple[str, str, str]]:
    """Return key figures of each actuator: value, unit, description."""
    row: ChannelErrors = twin.stroke_error[-1] if twin.stroke_error else twin.velocity_mae
    at_s = row.at_s if isinstance(row, StrokeErrors) else None
    what = "mean absolute error of {}" if at_s is None else f"error of {{}} after {figure(at_s)} s"
    return [(number(value), row.unit_of(name), what.format(name)) for name, value in row.by_channel.items()]
