"""``edp export``: a trained network in a form that runs without EDP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from edp.cli.console import JsonFlag, emit, out, waiting
from edp.cli.options import MapOption, RepairOption, complete, source_if_given
from edp.errors import ConfigError
from edp.storage.paths import full_path, is_file_at


def _names_of_formats() -> list[str]:
    from edp.workflows.export_forms import all_forms

    return list(all_forms())


def _list_forms(listing_asked: bool) -> None:
    """Print every export form with a one-line description."""
    if listing_asked:
        from edp.workflows.export_forms import all_forms

        for name, summary in all_forms().items():
            out.print(f"{name}: {summary}", soft_wrap=True)
        raise typer.Exit


FMU = "fmu"
COMPILING = "compiling the FMU's libraries; for the first one of a system the compiler builds its C runtime: minutes"


def export(
    bundle: Annotated[
        Path, typer.Argument(help="Bundle, run folder of edp train, edp twin or edp loop run, or a monitor.")
    ],
    form: Annotated[
        str,
        typer.Option(
            "--format",
            autocompletion=complete(_names_of_formats),
            help="Format, such as c (C99 for controllers); --formats lists all.",
        ),
    ],
    folder: Annotated[Path, typer.Option("--out", help="Folder for the files; an existing export is replaced.")],
    name: Annotated[
        str,
        typer.Option(help="Name in the exported files; default: predictor, machine (a controller), monitor, follower."),
    ] = "",
    changes: Annotated[
        list[str] | None, typer.Option("--set", help="Option of the format, such as opset=11 of onnx; may be repeated.")
    ] = None,
    w8a16: Annotated[
        list[Path],
        typer.Option(
            help="Of a twin: logs on which it is brought into W8A16, for forms around the C code; may be repeated."
        ),
    ] = [],  # noqa: B006
    twin: Annotated[
        Path | None,
        typer.Option("--twin", help="For --format follower: the run of a grey box of the machine as it was."),
    ] = None,
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    forms: Annotated[
        bool, typer.Option("--formats", callback=_list_forms, is_eager=True, help="List the formats and exit.")
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Export a model to C, FMU, Simulink, ROS 2, ONNX or CasADi, with inputs and outputs in SI units.

    Example: `edp export runs/first --format c --out firmware/predictor`

    Example: `edp export runs/first_adapted --format follower --twin runs/grey --out firmware/follower`
    """
    from edp.workflows.export_forms import ExportOrder, export_run

    options = dict(map(_option, changes or []))
    calibration = source_if_given(w8a16, signal_map, repair)
    order = ExportOrder(
        run=bundle, to=form, folder=folder, name=name, options=options, twin=twin, calibration=calibration
    )
    # Other forms are written in a moment, or run no compiler.
    slow = form == FMU and options.get("binaries") != "none"
    with waiting(COMPILING, quiet=as_json or not slow):
        exported = export_run(order)
    first = exported.files[0]

    def show() -> None:
        for file in exported.files:
            out.print(str(file))
        if exported.without_adaptation:
            out.print(f"note: the format '{form}' holds the network alone; its adaptation is held by c")
        out.print(f"written: {full_path(first.parent)}; read {first.name} first")
        if is_file_at(first.parent / "CMakeLists.txt"):
            where, build = first.parent, first.parent / "build"
            out.print(f"next: cmake -S {where} -B {build} && cmake --build {build} && ctest --test-dir {build}")

    emit(as_json, {"to": form, "name": exported.name, "files": [str(file) for file in exported.files]}, show)


def _option(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    # An empty value is a forgotten one.
    if not (name and equals and value):
        raise ConfigError(f"--set {text}: an option is NAME=VALUE, such as opset=11")
    return name.strip(), value.strip()
