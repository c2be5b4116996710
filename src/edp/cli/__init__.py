"""Command line: one module per command, which parses, calls the workflow and prints."""

from __future__ import annotations

import sys
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
    finetune,
    fleet,
    footprint,
    forecast,
    identify,
    init,
    inspect,
    live,
    monitor,
    parity,
    pretrain,
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
from edp.cli.notices import tell_of_missing_layers, tell_of_slow_logs, tell_of_unsealed_files
from edp.cli.process import stop_on_request, use_one_blas_thread
from edp.workflows import load_plugins

app = typer.Typer(
    name="edp",
    help="Fast, accurate plant models of hydraulic machines, learned from recordings and run as a stream.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    # Tracebacks are for developers; users get one message.
    pretty_exceptions_enable=False,
)
app.command("demo")(demo.demo)
app.command("simulate")(simulate.simulate)
app.command("init")(init.init)
app.command("inspect")(inspect.inspect)
app.add_typer(store.app, name="store")
app.command("screen")(screen.screen)
app.command("animate")(animate.animate)
app.command("train")(train.train)
app.command("evaluate")(evaluate.evaluate)
app.command("twin")(twin.twin)
app.command("rollout")(twin.rollout)
app.command("forecast")(forecast.forecast)
app.command("control")(control.control)
app.command("live")(live.live)
app.command("tune")(control.tune)
app.command("identify")(identify.identify)
app.add_typer(search.app, name="search")
app.command("distil")(distil.distil)
app.command("compress")(compress.compress)
app.command("pretrain")(pretrain.pretrain)
app.command("finetune")(finetune.finetune)
app.add_typer(fleet.app, name="fleet")
app.add_typer(registry.app, name="registry")
app.command("adapt")(adapt.adapt)
app.command("replay")(adapt.replay)
app.add_typer(monitor.app, name="monitor")
app.command("footprint")(footprint.footprint)
app.command("export")(export.export)
app.command("parity")(parity.parity)
app.command("quantise")(quantise.quantise)
app.command("report")(report.report)
app.command("compare")(compare.compare)
app.command("runs")(runs.runs)
app.command("doctor")(doctor.doctor)


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
    tell_of_unsealed_files()
    sys.exit(code)
