"""The tables of a study, in the form of the thesis's tables 4.3 to 4.8 where it has one."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from edp.errors import count_of
from edp.evaluation.study import PhaseRow, StudyFile
from edp.evaluation.study_facts import CalibrationFacts, ExplorationFacts, IsolationFacts, SynthesisFacts
from edp.report.common.chart import append_unit
from edp.report.search.facts import require_phase
from edp.report.search.modules import modules_tables, ordered, span
from edp.report.search.smaller import smaller_table
from edp.report.search.views import arm_views, titled
from edp.table import Column, Table, Value, chance, figures, plainly
from edp.wording import count_text, duration, moment, number, percent


def study_tables(study: StudyFile) -> dict[str, Table]:
    """Return the tables for which there are data, by name."""
    tables = (
        variance_table(study),
        features_table(study),
        calibration_table(study),
        *modules_tables(study),
        selection_table(study),
        identifiers_table(study),
        holdout_table(study),
        smaller_table(study),
        openings_table(study),
        phases_table(study),
    )
    return {table.name: table for table in tables if table is not None and table.rows}


@require_phase(IsolationFacts, None)
def variance_table(study: StudyFile, facts: IsolationFacts) -> Table | None:
    """Return the table 4.3: mean error and its standard deviations, of MAE and of the composite score."""
    rows = []
    for arm in arm_views(study):
        spreads = [value for s in (arm.mae, arm.composite) for value in (s.mean, s.split, s.seed)]
        rows.append((arm.backbone, arm.features, *spreads))
    heads = [(f"{name}{part}", study.unit) for name in ("MAE", "Composite") for part in ("", ", σ split", ", σ seed")]
    columns = (Column("Architecture"), Column("Features"), *_numbers(heads, [row[2:] for row in rows]))
    seeds = count_of(facts.seeds, "seed")
    caption = f"Variance by architecture and feature set: {count_of(facts.runs, 'run')} of {seeds} each"
    marked = frozenset(index for index, row in enumerate(rows) if row[1] == facts.features)
    return Table(caption, columns, tuple(rows), marked, name="variance")


def _numbers(heads: Sequence[tuple[str, str]], rows: Sequence[Sequence[Value]]) -> tuple[Column, ...]:
    """Return columns of values, each with its own precision."""
    return tuple(Column(*head, figures(values)) for head, values in zip(heads, zip(*rows), strict=True))


@require_phase(IsolationFacts, None)
def features_table(study: StudyFile, facts: IsolationFacts) -> Table | None:
    """Return the chosen feature set against the next best by backbone, and the best backbone against the others."""
    rows: tuple[tuple[Value, ...], ...] = tuple(
        (
            titled(backbone),
            f"{facts.features} against {comparison.reference}",
            100 * comparison.change,
            span(comparison.low, comparison.high),
            comparison.p,
        )
        for backbone, comparison in facts.comparisons.items()
    )
    # No p-value of these: which is the best was seen first.
    rows += tuple(
        (
            titled(comparison.best),
            f"against {titled(backbone)}, both {facts.features}",
            100 * comparison.change,
            span(comparison.low, comparison.high),
            None,
        )
        for backbone, comparison in facts.backbones.items()
    )
    columns = (
        Column("Architecture"),
        Column("Compared"),
        Column("Change of the score", "%", figures([row[2] for row in rows], signed=True, decimals=2)),
        Column("95 % interval", "%"),
        Column("p", "one-sided", chance),
    )
    return Table("Feature sets and architectures on the same folds with the same seeds", columns, rows, name="features")


@require_phase(CalibrationFacts, None)
def calibration_table(study: StudyFile, facts: CalibrationFacts) -> Table | None:
    """Return Table 4.4: scores of all questions of each architecture, and the choice of the efficiency rule."""
    rows = []
    final = {} if facts.final is None else facts.final.scores
    for backbone, calibration in facts.backbones.items():
        scores = [trial.score for trial in calibration.trials if trial.score is not None]
        errors = [trial.mae for trial in calibration.trials if trial.score is not None and trial.mae is not None]
        rows.append(
            (
                titled(backbone),
                f"{len(scores)} of {len(calibration.trials)}",
                *_spread(scores),
                min(scores, default=None),
                *_spread(errors),
                calibration.score,
                final.get(backbone),
                calibration.parameters,
            )
        )
    heads = [
        *(("Score, mean", study.unit), ("± σ", study.unit), ("Least", study.unit)),
        *(("MAE, mean", study.unit), ("± σ", study.unit), ("Taken", study.unit)),
        ("Taken, on all folds", study.unit),
    ]
    columns = (
        *(Column("Architecture"), Column("Questions", "done")),
        *_numbers(heads, [row[2:9] for row in rows]),
        Column("Parameters", "of the choice", _count),
    )
    marked = frozenset(i for i, name in enumerate(facts.backbones) if name == facts.backbone)
    isolation = study.facts(IsolationFacts)
    features = "" if isolation is None else f" with feature set {isolation.features}"
    caption = f"Questions of phase 1{features}; chosen is the smallest size that no larger one repays"
    return Table(caption, columns, tuple(rows), marked, name="calibration")


def _spread(values: Sequence[float]) -> tuple[float | None, float | None]:
    if not values:
        return None, None
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else None


def _count(value: Value) -> str:
    return count_text(value) if isinstance(value, int | float) else plainly(value)


def selection_table(study: StudyFile) -> Table | None:
    """Return the table 4.6: how often each module was on among the questions of phases 4 and 5."""
    decisions = {"Phase 4": study.facts(SynthesisFacts), "Phase 5": study.facts(ExplorationFacts)}
    on = {name: facts.on for name, facts in decisions.items() if facts is not None}
    names = list(dict.fromkeys(name for counts in on.values() for name in counts))
    rows: list[tuple[str, list[float]]] = []
    for name in names:
        shares = [100 * counts[name] if name in counts else 0.0 for counts in on.values()]
        rows.append((study.module(name), [*shares, float(np.mean(shares))]))
    rows.sort(key=lambda row: (-row[1][-1], row[0]))
    columns = (
        Column("Module"),
        *(Column(name, "%", figures([], decimals=1)) for name in on),
        Column("Mean", "%", figures([], decimals=1)),
    )
    caption = "How often each module was on among the questions"
    return Table(caption, columns, tuple((module, *shares) for module, shares in rows), name="selection")


def identifiers(study: StudyFile) -> dict[str, str]:
    """Return the table 4.7: short names of the modules, in their order."""
    return {name: f"M{number}" for number, (_, name) in enumerate(ordered(list(study.modules)), 1)}


def identifiers_table(study: StudyFile) -> Table | None:
    """Return the table 4.7."""
    rows = tuple((short, study.module(name), name) for name, short in identifiers(study).items())
    columns = (Column("ID"), Column("Module", is_text=True), Column("Name in settings", is_text=True))
    return Table("Module identifiers", columns, rows, name="identifiers") if "synthesis" in study.decided else None


@require_phase(SynthesisFacts, None)
def holdout_table(study: StudyFile, facts: SynthesisFacts) -> Table | None:
    """Return the table 4.8: baseline and winners; in brackets the change against the baseline."""
    calibrated, free = study.facts(CalibrationFacts), study.facts(ExplorationFacts)
    if calibrated is None:
        return None
    winners = [facts] if free is None else [facts, free]
    modules = [(), *(winner.modules for winner in winners)]
    costs = [calibrated.backbones[calibrated.backbone].costs, *(winner.costs for winner in winners)]
    short = identifiers(study)
    sizes, work = ([one[name] for one in costs] for name in ("parameters", "macs_tick"))
    rows: list[tuple[Value, ...]] = [
        ("Active modules", *(", ".join(short.get(name, name) for name in own) or "none" for own in modules)),
        ("Parameters", *(_compare_with(size, sizes[0], count_text) for size in sizes)),
        ("FP32 (MB)", *(number(4e-6 * size, 4) for size in sizes)),
        ("MACs per tick", *(_compare_with(value, work[0], count_text) for value in work)),
    ]
    for key, name in {"composite": "Composite", "mae": "MAE", "rmse": "RMSE", "p95": "P95", "p99": "P99"}.items():
        values = [facts.test[arm][key] for arm in ("baseline", "synthesis")]
        cells = [None if v is None else _compare_with(v, values[0], lambda x: number(x, 3)) for v in values]
        rows.append((append_unit(f"{name} on test sessions", study.unit), *cells, *([None] * (free is not None))))
    if free is not None:
        fresh = [free.fresh[arm] for arm in ("synthesis", "exploration")]
        cells = [number(fresh[0], 3), f"{number(fresh[1], 3)} ({percent(fresh[1] / fresh[0] - 1, True)} to phase 4)"]
        rows.append((append_unit("Composite on fresh folds", study.unit), None, *cells))
    names = ("Baseline", "Winner of phase 4", "Winner of phase 5")[: len(costs)]
    seeds = study.spec.get("run_seeds", "–")
    caption = f"Baseline and winners; test scores are means of {seeds} seeds, in brackets the change to the baseline"
    return Table(
        caption, (Column("Metric"), *(Column(name, is_text=True) for name in names)), tuple(rows), name="holdout"
    )


def _compare_with(value: float, reference: float | None, show: Callable[[float], str]) -> str:
    """Return a value with its change against a different reference."""
    if reference is None or value == reference or reference == 0:
        return show(value)
    return f"{show(value)} ({percent(value / reference - 1, signed=True)})"


def openings_table(study: StudyFile) -> Table | None:
    """Return every opening of the sealed test sets."""
    rows = tuple(
        (moment(opening.time), opening.why, len(opening.judged), opening.test_set) for opening in study.openings
    )
    columns = (Column("When"), Column("Why", is_text=True), Column("Trainings"), Column("Test set", is_text=True))
    return Table("Openings of the sealed test sets", columns, rows, name="openings")


def phases_table(study: StudyFile) -> Table | None:
    """Return the trainings and time of each phase, and their sums."""
    rows: list[tuple[Value, ...]] = [
        (p.heading, p.trainings, p.trained, p.pruned, p.failed, p.seconds, p.wall_s, _status(study, p))
        for p in study.all_phases
    ]
    sums = (
        sum(counts)
        for counts in zip(
            *((p.trainings, p.trained, p.pruned, p.failed, p.seconds, p.wall_s) for p in study.all_phases)
        )
    )
    if rows:
        rows.append(("All", *sums, None))
    count = figures([], decimals=0)
    columns = (
        Column("Phase"),
        Column("Asked for", "trainings", count),
        Column("Ended", "trainings", count),
        Column("Pruned", "trainings", count),
        Column("Failed", "trainings", count),
        Column("Training", "all workers", _time),
        Column("By the clock", "", _time),
        Column("State"),
    )
    caption = "Trainings and time by phase; one that an earlier phase asked for counts there"
    return Table(caption, columns, tuple(rows), frozenset({len(rows) - 1}), name="phases")


def _time(value: Value) -> str:
    return duration(value) if isinstance(value, int | float) else plainly(value)


def _status(study: StudyFile, phase: PhaseRow) -> str:
    if phase.name in study.decided:
        return "decided"
    return study.state if phase.began else "to come"
