"""Command ``edp compress estimate``: memory and computing cost of a network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, emit, out, table
from edp.wording import number

if TYPE_CHECKING:
    from edp.evaluation.controller import Budget, LimitCheck


def footprint(
    file: Annotated[Path, typer.Argument(help="Settings file (.toml), bundle, run folder, or monitor.")],
    budget: Annotated[
        Path | None,
        typer.Option("--budget", help="Limits of another controller (TOML); by default those of the thesis."),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Count parameters, multiply-accumulates, activations and state; estimate cycles and memory; hold them to a budget.

    Example: `edp compress estimate examples/thesis/table_b1.toml --budget examples/budgets/small_controller.toml`
    """
    from edp.evaluation.controller import CORES, Budget, load_budget
    from edp.workflows.deployment import footprint_of
    from edp.workflows.monitor.export_monitor import holds_monitor

    limits_of = Budget() if budget is None else load_budget(budget)
    if holds_monitor(file):
        _print_monitor_footprint(file, limits_of, as_json)
        return
    counts, name = footprint_of(file, None if budget is None else limits_of)
    facts = {"name": name, **counts.to_json(limits_of)}

    def show() -> None:
        rows = [(row.part, row.parameters, row.macs_tick, row.macs_window) for row in counts.rows]
        rows.append(("total", counts.parameters, counts.macs_tick, counts.macs_window))
        head = f"MACs per window of {counts.window}"
        table(name, ["part", "parameters", "MACs per tick", head], rows)
        out.print(f"parameters after folding {counts.parameters_folded:,}; state {counts.state_bytes:,} bytes")
        out.print()
        estimates = [
            (core.label, entry.number_format, *entry.cycles[key])
            for key, core in CORES.items()
            for entry in counts.estimates
        ]
        table("Cycles per tick, estimates", ["core", "numbers", "low", "typical", "high"], estimates)
        out.print()
        _budget_table(limits_of, counts.verdict(limits_of))
        for number_format, why in counts.refused.items():
            out.print(f"not in {number_format}: {why}")

    emit(as_json, facts, show)


def _print_monitor_footprint(file: Path, limits: Budget, as_json: bool) -> None:
    """Networks of a monitor, the chain behind them, and both against a budget."""
    from edp.evaluation.controller import CORES
    from edp.workflows.monitor.export_monitor import monitor_footprint_of

    counts = monitor_footprint_of(file)
    facts = {"name": file.name, **counts.to_json(limits)}

    def show() -> None:
        rows = [
            (i, one.number_format, one.footprint.parameters, one.runs, one.every, one.runs * one.footprint.macs_tick)
            for i, one in enumerate(counts.networks)
        ]
        table(file.name, ["network", "numbers", "parameters", "runs", "every, ticks", "MACs"], rows)
        chain = counts.chain
        out.print(
            f"behind the residuals, in double precision: {number(chain.mean, 0)} cycles a tick of a Cortex-M4F on "
            "average, "
            f"{number(chain.most, 0)} in the longest; state {counts.state_bytes:,} bytes"
        )
        out.print()
        cycles = [(core.label, *counts.cycles[key]) for key, core in CORES.items()]
        table("Cycles per tick, estimates", ["core", "low", "typical", "high"], cycles)
        out.print()
        _budget_table(limits, counts.verdict(limits))

    emit(as_json, facts, show)


def _budget_table(budget: Budget, checks: Sequence[LimitCheck]) -> None:
    """Print the comparison with a controller's limits."""
    rows = [(v.what, v.value, v.limit, v.unit, "fits" if v.fits else "too large", v.note) for v in checks]
    table(f"Budget: {budget.name}", ["", "value", "limit", "unit", "verdict", "meaning"], rows)
