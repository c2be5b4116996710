"""``edp footprint``: what a network costs to store and run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from edp.cli.console import JsonFlag, emit, out, table


def footprint(
    file: Annotated[Path, typer.Argument(help="Settings file (.toml), bundle, or run folder.")],
    as_json: JsonFlag = False,
) -> None:
    """Count parameters, multiply-accumulates, activations and state, and hold them against the thesis's budget.

    Example: `edp footprint examples/thesis/table_b1.toml`
    """
    from edp.evaluation.footprint import Budget
    from edp.workflow import footprint_of

    counts, name = footprint_of(file)
    facts = {"name": name, **counts.to_json(Budget())}

    def show() -> None:
        rows = [(r["part"], r["parameters"], r["macs_tick"], r["macs_window"]) for r in counts.rows]
        rows.append(("total", counts.parameters, counts.macs_tick, counts.macs_window))
        head = f"MACs per window of {counts.window}"
        table(name, ["part", "parameters", "MACs per tick", head], rows)
        out.print(f"parameters after folding {counts.parameters_folded:,}; state {counts.state_bytes:,} bytes")
        limits = [
            (v["what"], v["value"], v["limit"], v["unit"], "fits" if v["fits"] else "too large", v["note"])
            for v in facts["verdict"]
        ]
        out.print()
        table(f"Budget: {facts['budget']['name']}", ["", "value", "limit", "unit", "verdict", "meaning"], limits)

    emit(as_json, facts, show)
