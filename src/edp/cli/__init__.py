"""Command line: one module per command, which parses, calls the workflow and prints."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from io import TextIOWrapper
from typing import Annotated

import typer

from edp import __version__
from edp.cli import (
    adapt,
    animate,
    compare,
    compress,
    control,
    demo,
    distil,
    doctor,
    evaluate,
    export,
    fleet,
    footprint,
    forecast,
    identify,
    init,
    inspect,
    live,
    monitor,
    parity,
    quantise,
    registry,
    report,
    runs,
    screen,
    search,
    simulate,
    store,
    train,
    twin,
)
from edp.cli.console import err, run_app
from edp.cli.groups import Root
from edp.cli.notices import tell_of_earlier_keys, tell_of_missing_layers, tell_of_slow_logs, tell_of_unsealed_files
from edp.cli.process import stop_on_request, use_one_blas_thread
from edp.workflows import load_plugins

app = typer.Typer(
    name="edp",
    cls=Root,
    help="Fast, accurate plant models of hydraulic machines, learned from recordings and run as a stream.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    # Tracebacks are for developers; users get one message.
    pretty_exceptions_enable=False,
)


def _make_group(summary: str, commands: Mapping[str, Callable[..., None]]) -> typer.Typer:
    group = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown", help=summary)
    for name, function in commands.items():
        group.command(name)(function)
    return group


data_app = _make_group(
    "Check, select, convert and show recordings.",
    {
        "check": inspect.inspect,
        "screen": screen.screen,
        "animate": animate.animate,
        "add-forecasts": forecast.forecast,
    },
)
data_app.add_typer(store.app, name="store")
compress_app = _make_group(
    "Make a trained network smaller or faster.",
    {
        "distil": distil.distil,
        "quantise": quantise.quantise,
        "search": compress.compress,
        "estimate": footprint.footprint,
    },
)
loop_app = _make_group("Run and tune controllers in closed loop.", {"run": control.control, "tune": control.tune})
PANELS: tuple[tuple[str, Mapping[str, typer.Typer | Callable[..., None]]], ...] = (
    ("Start", {"init": init.init, "demo": demo.demo, "doctor": doctor.doctor}),
    ("Data", {"data": data_app}),
    ("Train", {"train": train.app, "twin": twin.twin, "search": search.app}),
    (
        "Evaluate",
        {
            "evaluate": evaluate.evaluate,
            "compare": compare.compare,
            "report": report.report,
            "runs": runs.runs,
            "rollout": twin.rollout,
        },
    ),
    ("Compress", {"compress": compress_app}),
    ("Deploy", {"export": export.export, "verify": parity.verify, "adapt": adapt.app}),
    ("Simulate", {"simulate": simulate.simulate, "calibrate": identify.identify}),
    ("Control", {"loop": loop_app}),
    ("Operate", {"monitor": monitor.app, "live": live.live, "fleet": fleet.app, "registry": registry.app}),
)
"""Commands and groups by the panel of `edp --help` that shows them."""
Root.order = tuple(name for _, entries in PANELS for name in entries)
for _panel, _entries in PANELS:
    for _name, _entry in _entries.items():
        if isinstance(_entry, typer.Typer):
            app.add_typer(_entry, name=_name, rich_help_panel=_panel)
        else:
            app.command(_name, rich_help_panel=_panel)(_entry)


def _version(show_version: bool) -> None:
    if show_version:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Learn a deployable plant model of a hydraulic machine from recordings."""
    for failure in load_plugins():
        err.print(f"warning: {failure}")


def main() -> None:
    """Entry point of ``edp``."""
    stop_on_request()
    use_one_blas_thread()
    if isinstance(sys.stdout, TextIOWrapper):  # a terminal that lacks a character gets its escape
        # An old terminal must not end a training because of a Greek letter.
        sys.stdout.reconfigure(errors="backslashreplace")
    tell_of_slow_logs()
    tell_of_missing_layers()
    code = run_app(app)
    tell_of_earlier_keys()
    tell_of_unsealed_files()
    sys.exit(code)
