"""``edp live``: a machine, its models and alarms in the browser, while it works."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.consent import ask_for_fmus
from edp.cli.console import JsonFlag, emit, err, out
from edp.cli.options import MapOption, within
from edp.errors import ConfigError
from edp.settings.bounds import MAX_SEED, span
from edp.storage.paths import full_path

if TYPE_CHECKING:
    from edp.live.server import LiveServer

LIVE_SOURCES = ("log", "sim", "loop", "udp", "ros2")


def live(
    run: Annotated[
        Path | None, typer.Argument(metavar="RUN", help="Run folder of edp train or edp twin; may be left out.")
    ] = None,
    log: Annotated[Path | None, typer.Option("--log", help="Play this log.")] = None,
    sim: Annotated[str | None, typer.Option("--sim", help="Run this machine of the simulator, such as M22.")] = None,
    loop: Annotated[
        str | None, typer.Option("--loop", help="Closed loops along this task, such as grade, or settings (.toml).")
    ] = None,
    udp: Annotated[
        int | None, typer.Option("--udp", min=0, max=65535, help="Take JSON datagrams on this port.")
    ] = None,
    ros2: Annotated[bool, typer.Option("--ros2", help="Take joints and pressures of ROS 2.")] = False,
    monitor: Annotated[Path | None, typer.Option("--monitor", help="Monitor that raises the alarms.")] = None,
    speed: Annotated[
        float | None, typer.Option(help="Factor on real time of a log, simulator or loop; default: 1.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 for a free one.")] = 0,
    bind: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    save: Annotated[Path | None, typer.Option("--save", help="Page (.html) to write at the end.")] = None,
    record: Annotated[Path | None, typer.Option("--record", help="Write the session as MCAP (.mcap).")] = None,
    rerun: Annotated[
        bool, typer.Option("--rerun", help="Show the session in Rerun besides; needs the extra [rerun].")
    ] = False,
    until_end: Annotated[bool, typer.Option("--until-end", help="End with the source, for scripts.")] = False,
    machine: Annotated[str | None, typer.Option(help="Machine or machine file (.toml) of the side view.")] = None,
    rate: Annotated[float | None, typer.Option(help="Rate (Hz) where no model says it.")] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, max=MAX_SEED, help="Of the simulator or the loop; default: 0.")
    ] = None,
    excitation: Annotated[str | None, typer.Option(help="Operator of --sim; default: combined.")] = None,
    fault: Annotated[list[str], typer.Option("--fault", help="Fault of --sim, as edp simulate takes it.")] = [],  # noqa: B006
    controller: Annotated[str | None, typer.Option(help="Controller of --loop, such as pi.")] = None,
    twin: Annotated[Path | None, typer.Option("--twin", help="Twin that the controller of --loop uses.")] = None,
    plant: Annotated[
        Path | None, typer.Option("--plant", help="Twin's run folder, or an FMU (.fmu), that is the plant of --loop.")
    ] = None,
    predictor: Annotated[
        Path | None, typer.Option("--predictor", help="Run folder of edp train that the controller of --loop uses.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Trust the native code of an FMU; do not ask.")] = False,
    udp_bind: Annotated[
        str | None, typer.Option("--udp-bind", help="Address that --udp listens on; default: 127.0.0.1.")
    ] = None,
    free_s: Annotated[
        float | None,
        typer.Option(
            "--rollout-seconds",
            callback=within(span(0.1, 86_400.0)),
            help="Length of a twin's simulations in seconds; default: 60.",
        ),
    ] = None,
    signal_map: MapOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Show a machine live in the browser: predictions, measurements, residuals, alarms and a side view.

    Only who has the printed address sees the page; nothing on it moves a machine. Ctrl-C ends.

    Example: `edp live runs/m22 --log data/m22/m22_000_combined.parquet --monitor monitors/m22`
    """
    from edp.workflows.live import LiveOrder, SourceOptions, check_options, run_live

    sources = {"log": log, "sim": sim, "loop": loop, "udp": udp, "ros2": "ros2" if ros2 else None}
    name, value = _source(sources)
    of_sources = {
        "map": signal_map, "machine": machine, "rate": rate, "seed": seed, "speed": speed, "excitation": excitation,
        "fault": fault or None, "controller": controller, "twin": twin, "plant": plant, "predictor": predictor,
        "yes": yes or None, "udp-bind": udp_bind, "until-end": until_end or None,
    }  # fmt: skip
    check_options(name, (option for option, entry in of_sources.items() if entry is not None))
    ask_for_fmus(yes, plant)
    settings = {
        "excitation": excitation, "faults": fault or None, "bind": udp_bind, "controller": controller, "twin": twin,
        "plant": plant, "predictor": predictor,
    }  # fmt: skip
    options = SourceOptions(
        str(value),
        signal_map,
        machine,
        seed,
        rate,
        {key: entry for key, entry in settings.items() if entry is not None},
    )
    order = LiveOrder(
        source=name, options=options, run=run, monitor=monitor, speed=1.0 if speed is None else speed, free_s=free_s,
        host=bind, port=port, save=save, record=record, rerun=rerun, until_end=until_end,
    )  # fmt: skip

    result = run_live(
        order,
        lambda server: _print_address(server, as_json),
        _print_event,
        on_mirror=lambda address: _print_mirror(address, as_json),
    )
    facts = {
        "ticks": result.ticks,
        "alarms": result.alarms,
        "ended": result.ended,
        "late": result.late,
        "saved": result.saved and str(result.saved),
        "recorded": result.recorded and str(result.recorded),
    }

    def show() -> None:
        out.print(f"{result.ticks:,} ticks, {result.alarms:,} alarms; {result.ended}")
        if result.saved is not None:
            out.print(f"session: {full_path(result.saved)}")
        if result.recorded is not None:
            out.print(f"recording: {full_path(result.recorded)}")

    emit(as_json, facts, show)


def _print_address(server: LiveServer, as_json: bool) -> None:
    # To standard error, so that JSON on standard output stays one document.
    (err if as_json else out).print(f"live view: {server.address}")
    (err if as_json else out).print("whoever has this address sees the session; Ctrl-C ends it")
    if not server.bind.is_loopback:
        err.print(f"the page is open to {server.bind.reach} that has the address; what it shows is not encrypted")


def _print_event(kind: str, text: str) -> None:
    if kind == "preparing":
        err.print(text)
    elif kind != "note":
        err.print(f"{kind}: {text}")


def _print_mirror(address: str, as_json: bool) -> None:
    (err if as_json else out).print(f"Rerun: {address}")
    err.print("Rerun has no token: every user of this machine can read there; its page calls its makers' servers")


def _source(options: Mapping[str, object]) -> tuple[str, object]:
    """Return the given source; raises ConfigError unless there is exactly one.

    Raises:
        ConfigError: there is no source, or more than one.
    """
    chosen = [(name, value) for name, value in options.items() if value is not None]
    if len(chosen) != 1:
        names = ", ".join(f"--{name}" for name in LIVE_SOURCES)
        what = "no source" if not chosen else " and ".join(f"--{name}" for name, _ in chosen)
        raise ConfigError(f"edp live takes one source, and {what} was given; choose one of {names}")
    return chosen[0]
