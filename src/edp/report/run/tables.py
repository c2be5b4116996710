"""Tables and key figures of a run's page; the network's row is marked."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from markupsafe import Markup

from edp.errors import count_of
from edp.evaluation.foundation_file import FoundationFile
from edp.evaluation.guard import MEASURE_NAME
from edp.evaluation.scores_file import MEAN, ModelScores, ScoresFile, error_at
from edp.report.run.facts import (
    NETWORK,
    ComparisonRow,
    Facts,
    comparison_rows,
    horizon_text,
    label_of,
    main_horizon,
)
from edp.report.run.figures import recording_errors
from edp.table import Column, Table, Value, figures, plainly
from edp.wording import MISSING, count_text, decimals_for, duration, figure, number, percent, unit_text

WORDS = {
    "rest": "at rest, now and then",
    "starting": "starting",
    "stopping": "stopping",
    "reversing": "reversing",
    "fast": "faster than half of the fastest",
    "dead_band": "moving, command in its dead band",
    "end_stop": "near an end stop",
    "other": "none of these",
}
"""Names of the situations of `edp.evaluation.by_situation` in tables."""

FITS, EXCEEDS = "✓ fits", "✗ exceeds"
_TILES = 3
"""Maximum number of outputs with their own tile if they have no common unit."""


def comparison_tables(facts: Facts) -> list[Table]:
    """Return the metrics of every model, one table per horizon, the headline's horizon first.

    Means over outputs where they have one unit, else the error of each output.
    """
    order = sorted(facts.horizons, key=lambda k: (k != main_horizon(facts), k))
    if not facts.averaged:
        return [table for horizon in order if (table := _tabulate_outputs(facts, horizon)) is not None]
    return [table for table in (_comparison(facts, horizon) for horizon in order) if table.rows]


def _comparison(facts: Facts, horizon: int) -> Table:
    rows = comparison_rows(facts, horizon)
    unit = facts.unit
    shown = [metric for metric in ("rmse", "mae", "p95", "p99", "composite") if _any(rows, metric)]
    places = {metric: decimals_for(row.metric(metric) for row in rows) for metric in shown}
    names = {"mae": "MAE", "rmse": "RMSE", "p95": "P95", "p99": "P99", "composite": "Composite"}
    with_bias, with_r2, with_time = _any(rows, "bias"), _any(rows, "r2"), _any(rows, "seconds")
    columns = [Column("Model"), *(Column(names[metric], unit) for metric in shown)]
    columns += [Column("Bias", unit)] * with_bias + [Column("R²")] * with_r2
    columns += [Column("Network relative to it", MEASURE_NAME)] + [Column("Fitted in")] * with_time
    lines = []
    for row in rows:
        cells = [row.label, *(number(row.metric(metric), places[metric]) for metric in shown)]
        cells += [number(row.bias, places["mae"], signed=True)] * with_bias
        cells += [number(row.r2, 4)] * with_r2
        cells += [percent(row.change, signed=True)]
        cells += [duration(row.seconds)] * with_time
        lines.append(tuple(cells))
    marked = frozenset(index for index, row in enumerate(rows) if row.is_network)
    return Table(f"{horizon_text(facts, horizon)} ahead", tuple(columns), tuple(lines), marked)


def _any(rows: Sequence[ComparisonRow], key: str) -> bool:
    return any(row.metric(key) is not None for row in rows)


def output_table(facts: Facts) -> Table | None:
    """Return the error by output at the longest horizon; None where `comparison_tables` shows it already."""
    return _tabulate_outputs(facts, main_horizon(facts)) if facts.averaged else None


def _tabulate_outputs(facts: Facts, horizon: int | None) -> Table | None:
    rows = comparison_rows(facts, horizon)
    if horizon is None or not rows or len(facts.targets) < 2:
        return None
    names = [target.name for target in facts.targets]
    places = {name: decimals_for(row.outputs[name] for row in rows) for name in names}
    lines = tuple((row.label, *(number(row.outputs[name], places[name]) for name in names)) for row in rows)
    units = [unit_text(target.unit) for target in facts.targets]
    columns = (Column("Model"), *(Column(target.description, unit) for target, unit in zip(facts.targets, units)))
    marked = frozenset(index for index, row in enumerate(rows) if row.is_network)
    return Table(f"{MEASURE_NAME} by output, {horizon_text(facts, horizon)} ahead", columns, lines, marked)


def interval_table(facts: Facts) -> Table | None:
    """Return the coverage and width of the network's intervals; None without intervals."""
    network = facts.models.get(NETWORK)
    rows = [] if network is None else [(k, row) for k in facts.horizons for row in network.intervals.get(str(k), ())]
    if network is None or not rows:
        return None
    places = decimals_for(row.width[MEAN] for _, row in rows)
    lines = tuple(
        (
            f"{horizon_text(facts, k)} ahead",
            percent(row.coverage),
            percent(row.covered[MEAN]),
            number(row.width[MEAN], places),
        )
        for k, row in rows
    )
    columns = (Column("Interval"), Column("Meant to hold"), Column("Holds"), Column("Mean width", facts.unit))
    caption = "The network's intervals: share of the truth inside, mean over outputs"
    scores = network.weighted_interval_score
    if scores:
        listed = ", ".join(
            f"{number(scores[str(k)][MEAN], places)} {facts.unit} {horizon_text(facts, k)} ahead".replace("  ", " ")
            for k in facts.horizons
            if str(k) in scores
        )
        caption += f"; weighted interval score (a point's is its MAE) {listed}"
    return Table(caption, columns, lines)


def worst_recordings_table(facts: Facts, most: int = 10) -> Table | None:
    """Return the recordings with the largest errors of the network, worst first."""
    horizon = main_horizon(facts)
    if horizon is None or NETWORK not in facts.models:
        return None
    order, errors = recording_errors(facts, horizon)
    if not order:
        return None
    models = [name for name in facts.models if name in errors]
    places = decimals_for(errors[NETWORK]) if NETWORK in errors else 2
    picked = list(range(len(order)))[::-1][:most]
    lines = tuple((order[i], *(number(errors[name][i], places) for name in models)) for i in picked)
    columns = (Column("Recording"), *(Column(label_of(facts, name), facts.unit) for name in models))
    return Table(
        f"The {count_of(len(picked), 'hardest recording')}, {horizon_text(facts, horizon)} ahead", columns, lines
    )


def budget_table(facts: Facts) -> Table:
    """Return the footprint against each limit of the budget; empty without a budget."""
    rows = []
    for check in facts.footprint.checks if facts.footprint else ():
        share = check.value / check.limit if check.limit else None
        verdict = FITS if check.fits else EXCEEDS
        amounts = (count_text(check.value), count_text(check.limit))
        rows.append((check.what, *amounts, check.unit, share, verdict, check.note))
    columns = (
        Column("Resource"),
        Column("Needed"),
        Column("Allowed"),
        Column("Unit", is_text=True),
        Column("Share used", show=_meter),
        Column("Verdict", show=_colour_verdict, is_text=True),
        Column("Note", is_text=True),
    )
    return Table("Budget", columns, tuple(rows))


def _meter(share: Value) -> Markup:
    """Return a bar and the percentage of a limit that is used."""
    text = percent(share if isinstance(share, float) else None)
    if not isinstance(share, float):
        return Markup(text)
    bar = Markup('<span class="meter{}"><i style="width: {}%"></i></span><span class="share">{}</span>')
    return bar.format(" over" if share > 1.0 else "", round(min(100.0 * share, 100.0), 1), text)


def _colour_verdict(verdict: Value) -> Markup:
    return Markup('<span class="fits{}">{}</span>').format(" over" if verdict == EXCEEDS else "", verdict)


def part_table(facts: Facts) -> Table | None:
    """Return the parameters and multiply-accumulates of each part of the network."""
    rows = facts.footprint.rows if facts.footprint else ()
    if not rows:
        return None
    columns = (Column("Part"), Column("Parameters"), Column("Per tick", "MAC"), Column("Per window", "MAC"))
    counts = ((row.parameters, row.macs_tick, row.macs_window) for row in rows)
    return Table("By part", columns, tuple((row.part, *map(count_text, each)) for row, each in zip(rows, counts)))


def footprint_rows(facts: Facts) -> list[tuple[str, str]]:
    """Return the network's size and cost: name and worded figure."""
    names = {
        "parameters": ("Parameters", ""),
        "parameters_folded": ("Parameters after folding", ""),
        "macs_tick": ("Work per tick, streaming", "MAC"),
        "macs_window": ("Work per window, from scratch", "MAC"),
        "float32": ("Constants on a controller, FP32", "B"),
        "w8a16": ("Constants on a controller, W8A16", "B"),
        "peak_activation_bytes": ("Peak activations, streaming", "B"),
        "peak_activation_bytes_window": ("Peak activations, window", "B"),
        "state_bytes": ("State carried between ticks", "B"),
        "window": ("Window", "samples"),
    }
    if facts.footprint is None:
        return []
    values = vars(facts.footprint) | {row.number_format: row.parameter_bytes for row in facts.footprint.estimates}
    figures = [(label, values.get(key), unit) for key, (label, unit) in names.items()]
    return [(label, f"{count_text(value)} {unit}".rstrip()) for label, value, unit in figures if value is not None]


def key_figures(facts: Facts) -> list[tuple[str, str, str]]:
    """Return the tiles under the headline: (figure, unit, description)."""
    rows = comparison_rows(facts)
    tiles: list[tuple[str, str, str]] = []
    ours = next((row for row in rows if row.is_network), None)
    if not facts.averaged and ours:
        for target in facts.targets[:_TILES]:
            tiles.append((number(ours.outputs[target.name]), unit_text(target.unit), f"{MEASURE_NAME}, {target.name}"))
        ours = None
    if ours:
        tiles.append((number(ours.rmse), facts.unit, f"{MEASURE_NAME} (root mean square of errors)"))
        if ours.p95 is not None:
            tiles.append((number(ours.p95), facts.unit, "95 % of errors are below"))
    best = next((row for row in rows if row.change is not None), None)
    if best and facts.averaged:
        tiles.append((percent(best.change, signed=True), "", f"error against {best.label}, the best baseline"))
    elif ours and ours.r2 is not None:
        tiles.append((number(ours.r2, 4), "", "R²"))
    checks = facts.footprint.checks if facts.footprint else ()
    if checks:
        fitting = sum(check.fits for check in checks)
        tiles.append((f"{fitting} of {len(checks)}", "", "budget limits met"))
    elif facts.provenance is not None and facts.provenance.more.get("parameters") is not None:
        tiles.append((count_text(facts.provenance.more["parameters"]), "", "parameters"))
    return [tile for tile in tiles if tile[0] != MISSING]


def situation_table(scores: ScoresFile, horizon: int) -> Table | None:
    """Return the errors of network and best baseline by situation, most of the error first; None without such scores.

    Args:
        scores: the content of ``scores.json``.
        horizon: samples ahead.
    """
    models = scores.models
    ours = models[NETWORK].by_situation.get(str(horizon), ()) if NETWORK in models else ()
    if not ours:
        return None
    shown = [t for t in scores.targets if any(row.mae.get(t.name) is not None for row in ours)]
    best = _best_baseline(models, horizon, [t.name for t in shown])
    baseline = {row.situation: row.mae for row in models[best].by_situation.get(str(horizon), ())} if best else {}
    rows = []
    for row in sorted(ours, key=lambda row: -row.of_error):
        errors = [row.mae.get(t.name) for t in shown]
        ratio = _ratio(errors, [baseline.get(row.situation, {}).get(t.name) for t in shown])
        cells = [WORDS.get(row.situation, row.situation), percent(row.share), percent(row.of_error), *errors]
        rows.append((*cells, *((percent(ratio),) if best else ())))
    errors_of = [Column(t.name, t.unit, figures(r[3 + i] for r in rows)) for i, t in enumerate(shown)]
    label = models[best].label or best if best else ""
    relative = (Column("Relative to", label),) if best else ()
    columns = (Column("Situation"), Column("Of the time"), Column("Of the error"), *errors_of, *relative)
    return Table("Mean absolute error by what the axis does", columns, tuple(rows), name="situations")


def _best_baseline(models: Mapping[str, ModelScores], horizon: int, targets: list[str]) -> str:
    """Return the baseline with the least sum of errors relative to the network's; empty without baselines."""
    network, sums = models[NETWORK], dict[str, float]()
    for name, model in models.items():
        if name != NETWORK and model.by_situation:
            errors = [[error_at(one.overall, horizon, t, "mae") for t in targets] for one in (model, network)]
            ratios = [a / b for a, b in zip(*errors, strict=True) if a is not None and b]
            if len(ratios) == len(targets):
                sums[name] = sum(ratios)
    return min(sums, key=lambda name: sums[name], default="")


def _ratio(ours: list[float | None], theirs: list[float | None]) -> float | None:
    """Return the geometric mean of the ratios of both, over the targets of which both have an error."""
    logs = [math.log(a / b) for a, b in zip(ours, theirs) if a and b]
    return math.exp(sum(logs) / len(logs)) if logs else None


def machine_parts_table(foundation: FoundationFile) -> Table:
    """Return the machines, recordings and minutes of each part."""
    heads = ("machines", "recordings", "minutes")
    rows = tuple((part, size.machines, size.recordings, size.minutes) for part, size in foundation.data.items())
    columns = (Column("Part"), *(Column(head.capitalize(), show=_short) for head in heads))
    return Table(f"{foundation.label} over many machines", columns, rows, name="parts")


def contexts_table(foundation: FoundationFile, unit: str = "report units") -> Table:
    """Return the error by the time since the state was reset, always on the same ticks."""
    unseen = foundation.unseen
    rows: list[tuple[Value, ...]] = []
    for row in unseen.contexts:
        half_width = None if row.change_error is None else 196 * row.change_error
        rows.append((row.seconds, row.mae, 100 * row.change, half_width))
    columns = (
        Column("Since reset", "s", _short),
        Column("MAE", unit, figures([row[1] for row in rows], decimals=3)),
        Column("Change", "%", figures([row[2] for row in rows], signed=True, decimals=1)),
        Column("95 %", "+- %", figures([row[3] for row in rows], decimals=1)),
    )
    caption = (
        f"Machines that were never seen ({len(unseen.machines)}), k = {foundation.horizon}: error by the time "
        f"since the state was reset, {unseen.ticks} ticks"
    )
    return Table(caption, columns, tuple(rows), name="contexts")


def _short(value: Value) -> str:
    return figure(value) if isinstance(value, int | float) else plainly(value)


def machines_table(foundation: FoundationFile, unit: str = "report units") -> Table:
    """Return each machine that tests, the hardest first."""
    each = sorted(foundation.unseen.machines.items(), key=lambda entry: -entry[1])
    columns = (Column("Machine"), Column("MAE", unit, figures([mae for _, mae in each])))
    return Table("Machines that were never seen, the hardest first", columns, tuple(each), name="machines")
