"""Figures of a search for a smaller network: the size profile of figures 4.5 and 4.6, and the front."""

from __future__ import annotations

from edp.evaluation.compression import CompressedRow, CompressionResult
from edp.report.common.chart import (
    BLUE,
    DROPPED,
    GREY,
    MUTED,
    ROUND_TICKS,
    RULE,
    SOFT,
    Bars,
    Chart,
    ChartAxis,
    Control,
    DataSeries,
    Mark,
    Panel,
    Symbol,
    append_unit,
)  # fmt: skip
from edp.report.compression.facts import COSTS, cost_of, smallest

AHEAD, COST = "horizon", "cost"
STAGES: tuple[tuple[str, str, Symbol, float, str], ...] = (
    ("before", "MAE in float32", "ring", 13, GREY),
    ("scores", "MAE in its format", "circle", 7, BLUE),
)
"""Stages of a compression: key in the scores, name, symbol, symbol size and colour."""


def profile_chart(facts: CompressionResult) -> Chart:
    """Return the parameters as bars and MAE before and after (left), composite scores with the front marked (right)."""
    indices = smallest(facts)
    rows = [facts.rows[index] for index in indices]
    names = [row.name for row in rows]
    unit, front = facts.unit, facts.front
    sizes = [row.resource_usage.parameters for row in rows]
    left: list[Mark] = [
        Bars(positions=names, values=sizes, colours=[RULE] * len(rows), name="parameters", hover="{y:,}"),
    ]
    right: list[Mark] = []
    for horizon in facts.horizons:
        when = {AHEAD: horizon}
        for key, name, symbol, size, colour in STAGES:
            values = [getattr(row, key)[horizon]["mae"] for row in rows]
            left.append(DataSeries(
                x=names, y=values, name=name, symbol=symbol, size=size, colour=colour, second=True, when=when
            ))  # fmt: skip
        right.append(Bars(
            positions=names, values=[row.scores[horizon]["composite"] for row in rows], when=when,
            colours=[BLUE if index in front else DROPPED for index in indices],
        ))  # fmt: skip
    across = ChartAxis(kind="names", slant=60)
    error = ChartAxis(append_unit("Mean absolute error", unit), kind="log", ticks=_ticks(facts), grid=False)
    panels = (
        Panel(tuple(left), across, ChartAxis("Parameters", kind="log", ticks=ROUND_TICKS), second=error),
        Panel(tuple(right), across, ChartAxis(append_unit("Composite score, the front in blue", unit))),
    )
    choice = Control(AHEAD, "Horizon", tuple((horizon, facts.ahead(horizon)) for horizon in facts.horizons))
    return Chart(
        "profile", panels, file="profile_k{horizon}", title="{horizon}", columns=2, choices=(choice,), height=480,
        inches=(max(8.0, 0.5 * len(rows) + 4), 4.2),
    )  # fmt: skip


def front_chart(facts: CompressionResult) -> Chart:
    """Return error relative to the teacher against cost, with the limit of the budget."""
    groups = list(dict.fromkeys(row.label for row in facts.rows))
    errors = [_percent(row) for row in facts.rows]
    marks: list[Mark] = []
    for cost in COSTS:
        when = {COST: cost}
        line = _front(facts, cost)
        marks.append(DataSeries(
            x=[x for x, _ in line], y=[y for _, y in line], name="front", width=2, step="after", when=when, hover=None
        ))  # fmt: skip
        for position, group in enumerate(groups):
            rows = [row for row in facts.rows if row.label == group]
            marks.append(DataSeries(
                x=[cost_of(row, cost) for row in rows], y=[_percent(row) for row in rows], name=group, when=when,
                symbol="circle", size=9, colour=MUTED[position % len(MUTED)], labels=[row.name for row in rows],
                hover="{label}: {y:+.2f} %, {x:,}",
            ))  # fmt: skip
        limit = getattr(facts.budget, cost)
        marks.append(DataSeries(
            x=[limit, limit], y=[min(errors), max(errors)], name="budget", width=2, colour=SOFT, dash="dot", when=when,
            hover=None,
        ))  # fmt: skip
    panel = Panel(
        tuple(marks),
        ChartAxis("Cost", titled_by=COST, kind="log", ticks=ROUND_TICKS, grid=True),
        ChartAxis("Error over the teacher's [%]"),
    )
    choices = (Control(COST, "Cost", tuple(COSTS.items())),)
    return Chart("front", (panel,), file="front_{cost}", title="Error against cost", choices=choices)


def _ticks(facts: CompressionResult) -> tuple[tuple[float, str], ...]:
    """Return the five round errors for each horizon, evenly spread on a logarithmic axis."""
    ticks = set()
    for horizon in facts.horizons:
        values = [row.scores[horizon]["mae"] for row in facts.rows]
        low, high = min(values), max(values)
        # A perfect error of zero has no place on a logarithmic axis.
        ticks |= {float(f"{low * (high / low) ** (step / 4):.2g}") for step in range(5)} if low > 0 else set()
    apart: list[float] = []
    for tick in sorted(ticks):
        # Texts of ticks that differ by less than a twelfth would cover each other.
        apart += [tick] if not apart or tick > 1.08 * apart[-1] else []
    return tuple((tick, f"{tick:.3g}") for tick in apart)


def _percent(row: CompressedRow) -> float:
    return 100 * (row.error - 1)


def _front(facts: CompressionResult, cost: str) -> list[tuple[float, float]]:
    """Return the points that no other one betters in error at no greater cost."""
    line: list[tuple[float, float]] = []
    for x, y in sorted((cost_of(row, cost), _percent(row)) for row in facts.rows):
        if not line or y < line[-1][1]:
            line.append((x, y))
    return line
