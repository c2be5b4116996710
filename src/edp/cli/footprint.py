"""``edp footprint``: what a network costs to store and run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from edp.cli.console import JsonFlag, emit, out, table


def footprint(
    file: Annotated[Path, typer.Argument(help="Settings file (.toml), bundle, or run folder.")],
    budget: Annotated[
        Path | None,
        typer.Option("--budget", help="Limits of another controller (TOML); by default those of the thesis."),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Count parameters, multiply-accumulates, activations and state; estimate cycles and memory; hold them to a budget.

    Example: `edp footprint examples/thesis/table_b1.toml --budget examples/budgets/small_controller.toml`
    """
    from edp.evaluation.controller import CORES, Budget, load_budget
    from edp.workflows.deployment import footprint_of

    limits_of = Budget() if budget is None else load_budget(budget)
    counts, name = footprint_of(file, None if budget is None else limits_of)
    facts = {"name": name, **counts.to_json(limits_of)}

    def show() -> None:
        rows = [(r["part"], r["parameters"], r["macs_tick"], r["macs_window"]) for r in counts.rows]
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
        limits = [
            (v["what"], v["value"], v["limit"], v["unit"], "fits" if v["fits"] else "too large", v["note"])
            for v in facts["verdict"]
        ]
        out.print()
        table(f"Budget: {facts['budget']['name']}", ["", "value", "limit", "unit", "verdict", "meaning"], limits)
        for number_format, why in counts.refused.items():
            out.print(f"not in {number_format}: {why}")

    emit(as_json, facts, show)
