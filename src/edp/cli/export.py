"""``edp export``: a trained network in a form that runs without EDP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from edp.cli.console import JsonFlag, emit, out, waiting
from edp.cli.train import MapOption, RepairOption, source_of
from edp.errors import ConfigError, closest

CONTROLLER, CONTROLLER_NAME = "controller", "machine"
"""The form of a run of edp control, and the name of what it holds unless one is given."""
FOLLOWER = "follower"
"""The form of a grey box that follows the machine, and the name of what it holds unless one is given."""
MONITOR_NAME = "monitor"


def _list_forms(listing_asked: bool) -> None:
    """Every registered target, with the first line of what is said about it."""
    if listing_asked:
        from edp.workflows.deployment import forms

        for name, summary in forms().items():
            out.print(f"{name}: {summary}", soft_wrap=True)
        out.print(
            f"{CONTROLLER}: C99, float32: the controller of a run of edp control, with model and solver", soft_wrap=True
        )
        out.print(
            f"{FOLLOWER}: C99, float64: a grey box that follows the machine, and moves a network's predictions",
            soft_wrap=True,
        )
        raise typer.Exit


FMU = "fmu"
COMPILING = "compiling the FMU's libraries; for the first one of a system the compiler builds its C runtime: minutes"


def export(
    bundle: Annotated[
        Path, typer.Argument(help="Bundle, run folder of edp train, edp twin or edp control, or a monitor.")
    ],
    to: Annotated[str, typer.Option(help="Form, such as c (C99 for controllers); --forms lists all.")],
    folder: Annotated[Path, typer.Option("--out", help="Folder for the files; an existing export is replaced.")],
    name: Annotated[
        str,
        typer.Option(help="Name in the exported files; default: predictor, machine (a controller), monitor, follower."),
    ] = "",
    changes: Annotated[
        list[str] | None, typer.Option("--set", help="Option of the form, such as opset=11 of onnx; may be repeated.")
    ] = None,
    w8a16: Annotated[
        Path | None,
        typer.Option(help="Of a twin: logs on which it is brought into W8A16, for forms around the C code."),
    ] = None,
    twin: Annotated[
        Path | None,
        typer.Option("--twin", help="For --to follower: the run of a grey box of the machine as it was."),
    ] = None,
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    forms: Annotated[
        bool, typer.Option("--forms", callback=_list_forms, is_eager=True, help="List the forms and end.")
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Write a trained network in a form that runs without EDP; it reads and gives SI units.

    Example: `edp export runs/first --to c --out firmware/predictor`

    Example: `edp export runs/first_adapted --to follower --twin runs/grey --out firmware/follower`
    """
    from edp.workflows.deployment import export_bundle, unheld_adaptation
    from edp.workflows.deployment import forms as registered_forms
    from edp.workflows.monitor.export_monitor import export_monitor, holds_monitor

    names = (CONTROLLER, FOLLOWER, *registered_forms())
    if to not in names:
        raise ConfigError(f"unknown export target '{to}'{closest(to, names)}; `edp export --forms` lists them")
    monitor = holds_monitor(bundle)
    usual = {CONTROLLER: CONTROLLER_NAME, FOLLOWER: FOLLOWER}
    name = name or (MONITOR_NAME if monitor else usual.get(to, "predictor"))
    options = dict(map(_option, changes or []))
    if (to == FOLLOWER) != (twin is not None):
        raise ConfigError(
            "--to follower and --twin belong together: edp export RUN --to follower --twin GREY, RUN of edp adapt and "
            "GREY of a grey box (edp twin --set twin.kind=greybox)"
        )
    if (monitor or to in usual) and w8a16 is not None:
        raise ConfigError("--w8a16: only twins are brought into W8A16 while they are exported; leave it out")
    if monitor:
        files = export_monitor(bundle, to, folder, name, options)
    elif twin is not None:
        from edp.workflows.adaptation import export_follower

        files = export_follower(bundle, twin, folder, name, options)
    elif to == CONTROLLER:
        from edp.workflows.control import export_controller

        files = export_controller(bundle, folder, name, options)
    else:
        source = None if w8a16 is None else source_of(w8a16, signal_map, repair)
        # Other forms are written in a moment, or run no compiler.
        slow = to == FMU and options.get("binaries") != "none"
        with waiting(COMPILING, quiet=as_json or not slow):
            files = export_bundle(bundle, to, folder, name, options, source)

    def show() -> None:
        for file in files:
            out.print(str(file))
        if to not in usual and not monitor and unheld_adaptation(bundle, to):
            out.print(f"note: the form '{to}' holds the network alone; its adaptation is held by c")
        out.print(f"written: {files[0].parent.resolve()}; read {files[0].name} first")
        if (files[0].parent / "CMakeLists.txt").is_file():
            where, build = files[0].parent, files[0].parent / "build"
            out.print(f"next: cmake -S {where} -B {build} && cmake --build {build} && ctest --test-dir {build}")

    emit(as_json, {"to": to, "name": name, "files": [str(file) for file in files]}, show)


def _option(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    # An empty value is a forgotten one.
    if not (name and equals and value):
        raise ConfigError(f"--set {text}: an option is NAME=VALUE, such as opset=11")
    return name.strip(), value.strip()
