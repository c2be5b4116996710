"""``edp registry``: networks on disk with their lineage."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edp.cli.console import JsonFlag, emit, err, out, table
from edp.storage.paths import full_path

if TYPE_CHECKING:
    pass

RegistryArgument = Annotated[Path, typer.Argument(metavar="REGISTRY", help="Folder of the registry.")]

app = typer.Typer(
    name="registry",
    help="Store trained networks with their history: data, base network and evaluation.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)


@app.command("add")
def add(
    registry: RegistryArgument,
    source: Annotated[Path, typer.Argument(help="Run folder, bundle, or folder of edp train finetune --fleet.")],
    name: Annotated[str, typer.Option(help="Name of the entry; the latest of one name is meant.")],
    as_json: JsonFlag = False,
) -> None:
    """Copy a network, or the deltas of a fleet, into a registry. Existing entries are never overwritten.

    Example: `edp registry add registry runs/foundation --name foundation`
    """
    from edp.workflows.fleet.registry import add_to_registry

    entry = add_to_registry(registry, source, name)

    def show() -> None:
        out.print(f"{entry.kind} '{entry.name}' is {entry.id} in {registry}")
        out.print(f"next: edp registry show {registry} {entry.name}")

    emit(as_json, asdict(entry), show)


@app.command("list")
def list_entries(registry: RegistryArgument, as_json: JsonFlag = False) -> None:
    """List a registry, the oldest entry first.

    Example: `edp registry list registry`
    """
    from edp.workflows.fleet.registry import list_registry

    entries, damaged = list_registry(registry)

    def show() -> None:
        rows = [(e.name, e.id[:12], e.kind, e.label, e.base[:12], e.added) for e in entries]
        table(f"registry {registry}", ["name", "id", "kind", "what", "base", "added"], rows)
        for line in damaged:
            err.print(f"damaged: {line}")

    emit(as_json, {"entries": [asdict(entry) for entry in entries], "damaged": damaged}, show)


@app.command("show")
def show_entry(
    registry: RegistryArgument,
    asked: Annotated[str, typer.Argument(metavar="ENTRY", help="Name, or beginning of the identifier.")],
    as_json: JsonFlag = False,
) -> None:
    """Show one entry, check its files against its identifier, and show its origin.

    Example: `edp registry show registry foundation`
    """
    from edp.workflows.fleet.registry import FILES, check_entry, find_entry, lineage

    entry = find_entry(registry, asked)
    check_entry(registry, entry)
    steps = lineage(registry, entry)
    files = full_path(registry / FILES / entry.id)

    def show() -> None:
        facts = [
            ("name", entry.name),
            ("id", entry.id),
            ("what", entry.label),
            ("added", entry.added),
            ("files", files),
        ]
        table(
            f"{entry.kind} of {registry}", ["", ""], [*facts, *_rows("data", entry.data), *_rows("judge", entry.judge)]
        )
        for step in steps:
            absent = f"{step} (not in this registry)"
            out.print(f"from: {absent if isinstance(step, str) else f'{step.name} ({step.id}): {step.label}'}")
        if not steps:
            out.print("from: random weights")

    chain = [step if isinstance(step, str) else step.id for step in steps]
    emit(as_json, {**asdict(entry), "lineage": chain, "files": str(files)}, show)


def _rows(what: str, facts: Any) -> list[tuple[str, str]]:
    return [(f"{what}: {key}", str(value)) for key, value in facts.items()]
