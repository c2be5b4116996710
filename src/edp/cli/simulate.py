"""``edp simulate``: a data set from the built-in excavator."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, Steps, count_text, emit, err, format_time_left, out, progress, table
from edp.cli.options import ClusterOption, OpenOption, WorkersOption, check_effects, parse_minutes, workers_of
from edp.cli.progress import show_progress
from edp.errors import count_of
from edp.wording import figure, number

if TYPE_CHECKING:
    from edp.jobs import Workers
    from edp.sim.data_set import SimulationOrder
    from edp.sim.limit_file import LimitFile
    from edp.sim.predictability import LimitSpec
    from edp.sim.scenario import Scenario


def simulate(
    context: typer.Context,
    folder: Annotated[Path, typer.Argument(help="Folder for the logs; an unfinished data set continues.")],
    scenario: Annotated[
        Path | None,
        typer.Option(help="Scenario file (.toml) with these settings; options of the command line take precedence."),
    ] = None,
    machine: Annotated[str | None, typer.Option(help="M22 (default), C14, or the path of a machine file.")] = None,
    minutes: Annotated[
        float | None,
        typer.Option(
            "--duration",
            parser=parse_minutes,
            metavar="TIME",
            help="Total length of all recordings with a unit, such as 90min or 2h; default: 60min.",
        ),
    ] = None,
    recordings: Annotated[int | None, typer.Option(help="Number of recordings; default: 30.")] = None,
    seed: Annotated[
        int | None, typer.Option(help="Random seed; equal seeds give bit-identical data; default: 0.")
    ] = None,
    family: Annotated[
        int | None,
        typer.Option(help="Number of random machines, scaled and scattered from M22, in place of one machine."),
    ] = None,
    material: Annotated[
        list[str] | None,
        typer.Option(
            help="Soil that digging and grading work in: dry_sand, sandy_loam, clay, gravel, or the path of a "
            "material file (.toml); air for none. Give it again for more soils, in equal shares."
        ),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            help="Fault of machine or sensors in every recording, KIND[:SITE][:SIZE][@ONSET][,ramp=TIME]"
            "[,on=TIME,off=TIME], such as internal_leak:arm:3L/min@120s. Give it again for more faults."
        ),
    ] = None,
    form: Annotated[
        str | None,
        typer.Option("--format", help="Ending of the logs, of any format that EDP writes (default: parquet)."),
    ] = None,
    changes: Annotated[
        list[str],
        typer.Option("--set", help="One key of a scenario file, such as masses=[12,30] or files.layout=speedgoat."),
    ] = [],  # noqa: B006
    workers: WorkersOption = 0,
    limit: Annotated[
        bool, typer.Option("--limit", help="Also compute the limit of predictability: limit.json.")
    ] = False,
    cluster: ClusterOption = "",
    open_cluster: OpenOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Simulate recordings of an excavator, by default machine M22 in free air, or from a scenario file.

    Example: `edp simulate data/m22 --duration 90min --recordings 30 --seed 1`

    Example: `edp simulate data/c14 --scenario examples/scenarios/c14_soil.toml`

    Example: `edp simulate data/many --family 8 --set masses=[12,30] --material clay`

    Example: `edp simulate data/leak --fault internal_leak:arm:3L/min@120s --fault pressure_bias:arm_head:10bar@5min`

    Example: `edp simulate data/m22 --limit --set limit.moments=60 --set limit.horizons=[1,10]`

    With --limit, moments of the recordings are branched with fresh randomness of operator, soil and sensors. Of each
    later velocity the least mean absolute error follows that any predictor could reach: one that knows the true state
    and all laws, but neither the operator's future choices nor, in the second column, anything but them.
    """
    from edp.sim.data_set import SimulationOrder
    from edp.sim.faults import fault_text, parse_fault
    from edp.sim.scenario_file import limit_settings, suffix_of

    check_effects(context, {"changes.limit": limit})
    order = SimulationOrder.from_scenario(
        scenario,
        lambda text: err.print(f"note: {text}"),
        changes,
        machine=machine,
        minutes=minutes,
        recordings=recordings,
        seed=seed,
        family=family,
        # Equal shares of several soils.
        materials=dict.fromkeys(material, 1.0) if material else None,
        suffix=None if form is None else suffix_of(form),
        faults=tuple(map(parse_fault, fault)) if fault else None,
    )
    # Settings of the limit are checked even where it is not asked for.
    spec = limit_settings(scenario, changes)
    divided = workers_of(workers, cluster, open_cluster, usual=0)
    paths = run(folder, order, divided, as_json)
    limit_facts = run_limit(folder, order, spec, divided, as_json) if limit else None
    what_simulated = f"{order.family} machines" if order.family else order.machine
    faults = [fault_text(entry) for entry in order.faults or ()]
    facts: dict[str, object] = {"folder": str(folder), "recordings": len(paths), "minutes": order.minutes}
    if faults:
        facts["faults"] = faults
    facts |= {"machine": what_simulated, "seed": order.seed}
    if limit_facts is not None:
        facts["limit"] = limit_facts.to_table()

    def show() -> None:
        if limit_facts is not None:
            limit_table(limit_facts)
        out.print(f"{count_of(len(paths), 'recording')} of {what_simulated}, {figure(order.minutes)} min, in {folder}")
        for text in faults:
            out.print(f"fault: {text}")
        out.print(f"next: edp data check {folder}   or   edp train {folder} --out runs/first")

    emit(as_json, facts, show)


def run(folder: Path, order: SimulationOrder, workers: Workers | None = None, quiet: bool = False) -> list[Path]:
    """Simulate with a progress display."""
    from edp.sim.data_set import ONE_PER_CORE, simulate_data_set

    began, steps, counts = time.monotonic(), Steps(quiet), {"kept": 0, "new": 0, "seconds": 0.0}
    with progress(quiet) as shown:
        bar = shown.add_task("simulate", total=order.recordings, note="")

        def on_done(scenario: Scenario, existed: bool) -> None:
            counts["kept" if existed else "new"] += 1
            counts["seconds"] += 0.0 if existed else scenario.duration_s
            elapsed = time.monotonic() - began
            done = counts["kept"] + counts["new"]
            # Recordings that were there before took no time, and say nothing about the others.
            left = elapsed / max(1, counts["new"]) * (order.recordings - done)
            note = f"{number(counts['seconds'] / max(1e-9, elapsed), 0)} simulated s per s"
            shown.update(bar, advance=1, note=note)
            steps.say(
                f"simulate: recordings {count_text(round(done), order.recordings)}, {note}{format_time_left(left)}"
            )

        return simulate_data_set(folder, order, workers or ONE_PER_CORE, on_done)


def run_limit(folder: Path, order: SimulationOrder, spec: LimitSpec, workers: Workers, quiet: bool) -> LimitFile:
    """Find the limit of predictability with a progress display."""
    from edp.sim.data_set import find_data_set_limit

    with show_progress("limit", quiet, "branched", timed=True) as progress:
        return find_data_set_limit(folder, order, spec, workers, progress)


def limit_table(limit: LimitFile) -> None:
    """Print the limit together with persistence."""
    names = [
        target.replace("CylVels_1", "boom").replace("CylVels_2", "arm").replace("CylVels_3", "bucket")
        for target in limit.targets
    ]
    rows = []
    for n, samples in enumerate(limit.horizons):
        unknown, commands_known = limit.commands_unknown, limit.commands_known
        spread = f"{number(unknown.low[n][-1], 2)}-{number(unknown.high[n][-1], 2)}"
        row = [
            f"{samples} ({figure(1000 * samples / limit.rate_hz)} ms)",
            *(number(v, 2) for v in unknown.mae[n]),
        ]
        rows.append(
            [
                *row,
                spread,
                number(commands_known.mae[n][-1], 2),
                number(limit.persistence.mae[n][-1], 2),
            ]
        )
    title = (
        f"Least mean absolute error of any predictor, {limit.unit} "
        f"({limit.moments} moments of {count_of(limit.recordings, 'recording')}, {limit.branches} futures "
        "each)"
    )
    table(title, ["k", *names, "mean", "95 %", "commands known", "persistence"], rows)
