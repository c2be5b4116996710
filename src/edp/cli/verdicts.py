"""First line, JSON and exit code of commands that compare a model with a reference."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from edp.cli.console import out

if TYPE_CHECKING:
    from edp.evaluation.guard import ErrorVerdict


def show_verdict(verdict: ErrorVerdict | None) -> None:
    """Print the verdict as the first line of a command."""
    if verdict is not None:
        out.print(verdict.sentence(), style="bold red" if verdict.exit_code else "bold")


def verdict_facts(verdict: ErrorVerdict | None) -> dict[str, object]:
    """Return a verdict as JSON has it; ``beaten_by`` names the reference where the outcome is *worse*."""
    beaten = verdict is not None and verdict.exit_code
    return {
        "beaten_by": verdict.label if verdict is not None and beaten else None,
        "verdict": None if verdict is None else str(verdict.outcome),
        "verdict_sentence": None if verdict is None else verdict.sentence(),
    }


def end_with(verdict: ErrorVerdict | None) -> None:
    """End a command with the exit code of its verdict, so that scripts need not read JSON."""
    if verdict is not None and verdict.exit_code:
        raise typer.Exit(verdict.exit_code)
