"""Result of a compression as tables and points."""

from __future__ import annotations

from edp.errors import count_of
from edp.evaluation.compression import CompressedRow, CompressionResult
from edp.table import Column, Table, Value, figures
from edp.wording import listed, number, percent

LIMITS = {"cycles": "cycles", "parameter_bytes": "parameters", "ram_bytes": "memory", "flash_bytes": "flash"}
COSTS = {"cycles": "Cycles per tick, high estimate", "parameter_bytes": "Memory for parameters [bytes]"}


def smallest(facts: CompressionResult) -> list[int]:
    """Return the index of each network's smallest format; the teacher in float32 comes first."""
    rows, smallest = facts.rows, dict[tuple[str, bool], int]()
    for index, row in enumerate(rows):
        network = row.run, row.recipe == "teacher" and row.number_format == "float32"
        best = smallest.setdefault(network, index)
        if row.resource_usage.parameter_bytes < rows[best].resource_usage.parameter_bytes:
            smallest[network] = index
    return sorted(smallest.values(), key=lambda index: (rows[index].recipe != "teacher", index))


def cost_of(row: CompressedRow, name: str) -> float:
    """Return a cost of `COSTS`."""
    usage = row.resource_usage
    return float(usage.cycles[2] if name == "cycles" else usage.parameter_bytes)


def front_table(facts: CompressionResult, horizon: str) -> Table:
    """Return a table in the form of Table 4.9 with memory and time on the controller; rows on the front are marked."""
    teacher, unit = facts.teacher.scores[horizon]["mae"], facts.unit
    rows: list[tuple[Value, ...]] = []
    for row in facts.rows:
        usage, mae = row.resource_usage, row.scores[horizon]["mae"]
        rows.append(
            (
                row.name,
                row.recipe,
                mae,
                100 * (mae / teacher - 1),
                usage.parameters,
                usage.parameter_bytes / 1e6,
                row.label,
                usage.macs_window / 1e6,
                usage.macs_tick,
                usage.cycles[2],
                "fits" if row.fits else f"over: {listed(LIMITS[name] for name in row.over)}",
            )
        )
    columns = (
        Column("Variant"),
        Column("Made", is_text=True),
        Column("MAE", unit, figures([row[2] for row in rows])),
        Column("Δ MAE", "%", figures([row[3] for row in rows], signed=True, decimals=2)),
        Column("Parameters", "", figures([], decimals=0)),
        Column("Size", "MB", figures([], decimals=4)),
        Column("Numbers", is_text=True),
        Column("MACs per window", "M", figures([], decimals=3)),
        Column("MACs per tick", "", figures([], decimals=0)),
        Column("Cycles, high", "", figures([], decimals=0)),
        Column("Budget", is_text=True),
    )
    caption = f"{facts.ahead(horizon)}, validation part"
    return Table(caption, columns, tuple(rows), frozenset(facts.front), name=f"k{horizon}")


def tabulate_held_out(facts: CompressionResult) -> Table | None:
    """Return the teacher and chosen on the sealed test set."""
    scores = facts.held_out_test.scores
    if not scores:
        return None
    rows: list[tuple[Value, ...]] = []
    for horizon, first in scores["teacher"].items():
        last = scores["chosen"][horizon]
        change = 100 * (last["mae"] / first["mae"] - 1)
        composites = first["composite"], last["composite"]
        rows.append((facts.ahead(horizon), first["mae"], last["mae"], change, *composites))
    unit = facts.unit
    columns = (
        Column("Horizon"),
        Column("MAE, teacher", unit, figures([row[1] for row in rows])),
        Column("MAE, chosen", unit, figures([row[2] for row in rows])),
        Column("Δ MAE", "%", figures([], signed=True, decimals=2)),
        Column("Composite, teacher", unit, figures([row[4] for row in rows])),
        Column("Composite, chosen", unit, figures([row[5] for row in rows])),
    )
    return Table("On recordings that took part in no choice", columns, tuple(rows), name="held_out_test")


def headline(facts: CompressionResult) -> str:
    """State the result in one sentence."""
    best, budget = facts.best, facts.budget.name
    if best is None:
        return f"None of the networks made fits the budget “{budget}”"
    return f"{best.name} fits “{budget}” with an error {percent(best.error - 1, signed=True)} against the teacher's"


def verdict(facts: CompressionResult) -> list[str]:
    """Return the sentences under the headline."""
    if facts.best is None:
        near = min(facts.rows, key=lambda row: max(value / limit for value, limit in row.over.values()))
        over = listed(f"{LIMITS[k]} {v:,} of {limit:,}" for k, (v, limit) in near.over.items())
        return [f"The nearest is {near.name}: {over}."]
    usage, budget = facts.best.resource_usage, facts.budget
    lines = [
        f"It takes {usage.cycles[2]:,} of {budget.cycles:,} cycles a tick (high estimate) and "
        f"{usage.parameter_bytes:,} of {budget.parameter_bytes:,} bytes for parameters."
    ]
    if facts.held_out_test.error is not None:
        change = percent(facts.held_out_test.error - 1, signed=True)
        lines.append(f"On the sealed test set its MAE is {change} against the teacher's.")
    return lines


def caveats(facts: CompressionResult) -> list[str]:
    """Return the limits of the evidence."""
    held_out, parts = facts.held_out_test, facts.recordings
    lines = [
        "Cycles, program and memory beside constants are estimates; MACs are counted, and so are the bytes of all "
        "constants, as the exported C code holds them (INT8 has no such code: one byte for each weight). The high "
        "estimate decides.",
        f"Networks are compared and chosen on {count_of(parts.validation, 'validation recording')}, which chose "
        "their best "
        "epochs too: the least of many errors is a little too good there.",
        f"The sealed test set, {count_of(parts.test, 'recording')}, was opened for the chosen network and the "
        "teacher alone.",
        "One training each: differences of a percent between neighbours may be chance.",
    ]
    if held_out.seen_before:
        lines.append(
            "The run of the teacher was judged on the sealed test set before, so the teacher was perhaps chosen by it. "
            "Recordings that nobody looked at, given with --data, would show more."
        )
    if len(held_out.openings) > 1:
        lines.append(
            f"The sealed test set was opened {len(held_out.openings)} times; openings after the first show less."
        )
    return [*lines, *facts.notes]


def tiles(facts: CompressionResult) -> list[tuple[str, str, str]]:
    """Return the key figures: value, unit, meaning."""
    best, unit = facts.best, facts.unit
    if best is None:
        return []
    horizon, usage = facts.horizons[-1], best.resource_usage
    return [
        (number(best.scores[horizon]["mae"]), unit, f"MAE {facts.ahead(horizon)}"),
        (number(facts.teacher.scores[horizon]["mae"]), unit, "MAE of the teacher"),
        (f"{usage.parameter_bytes / 1e3:.1f}", "kB", "for parameters"),
        (f"{usage.cycles[2] / 1e3:,.0f}", "k", "cycles per tick, high estimate"),
        (f"{usage.macs_tick / 1e3:,.1f}", "k", "MACs per tick"),
    ]
