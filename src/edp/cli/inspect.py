"""Command ``edp data check``: content and problems of logs, and coverage of a data set."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edp.cli.console import JsonFlag, emit, err, out, print_table, table
from edp.cli.options import ClusterOption, LogsArgument, MapOption, OpenOption, WorkersOption, workers_of
from edp.cli.progress import show_progress
from edp.cli.quality import MaxHoursOption, show_between, show_lines, show_report, verdict_text
from edp.errors import DataError, EdpError, count_of
from edp.storage.paths import full_path, is_file_at
from edp.wording import figure, number, percent

if TYPE_CHECKING:
    from edp.data.coverage import Coverage
    from edp.logs.source import DataSource

SETTINGS = "settings.toml"
"""What `edp init` writes beside a map."""
# Scripts can tell unusable data by the exit code.
FAULTY = 3


MOST_CHANNELS = 12
"""Of a single log whose channels are all shown without --details."""


def inspect(
    data: LogsArgument,
    signal_map: MapOption = None,
    details: Annotated[
        bool | None,
        typer.Option(
            help="Show each channel and finding of each log, and all coverage; default: of one log of few channels."
        ),
    ] = None,
    covered: Annotated[
        bool, typer.Option("--coverage/--no-coverage", help="Show the coverage of the operating range.")
    ] = True,
    page: Annotated[Path | None, typer.Option(help="Also write quality and coverage as an offline HTML page.")] = None,
    split: Annotated[
        str, typer.Option(help="Also report the distance of tests from training data: recordings, blocks, time.")
    ] = "",
    inputs: Annotated[
        str, typer.Option(help="Command channels, where names and kinds do not identify them: a,b.")
    ] = "",
    max_hours: MaxHoursOption = None,
    workers: WorkersOption = 1,
    cluster: ClusterOption = "",
    open_cluster: OpenOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Report the quality of recordings: time, gaps, noise, steps, clipping, units, repeats. Nothing is changed.

    Then what the data cover: how rich the inputs are, poses, joint histograms, events.
    Ends with exit code 3 where a log has an error that training would refuse.

    Example: `edp data check logs/ --map mine.toml --page coverage.html`
    """
    from edp.logs.source import DataSource

    source = replace(DataSource.from_path(data, signal_map), at_most_h=max_hours)
    asked = page is not None or bool(split or inputs)
    names = tuple(filter(None, inputs.split(",")))
    with show_progress("read", as_json) as progress:
        quality = source.inspect(progress, workers_of(workers, cluster, open_cluster))
    errors = quality.errors
    coverage_facts, why = None, "" if covered or asked else "not asked for"
    # Recordings with errors have no coverage: training would refuse them.
    if quality.proposed and (covered or asked):
        why = "no signal map says which channels command and which move; edp init proposes one (--map)"
        if asked:
            raise DataError(f"'{source.label}': {why}")
    elif not errors and (covered or asked):
        coverage_facts, why = _coverage(source, split, names, asked)
    if coverage_facts is not None and page is not None:
        from edp.report import build_coverage_page

        build_coverage_page(coverage_facts, full_path(data[0]).stem, quality).write(page)

    def show() -> None:
        few = len(quality.reports) == 1 and len(quality.reports[0].channels) <= MOST_CHANNELS
        whole = few if details is None else details
        if whole:
            for report in quality.reports:
                show_report(report)
        else:
            show_lines(quality)
        show_between(quality)
        if coverage_facts is not None:
            show_coverage(coverage_facts, whole)
        elif why and covered:
            out.print(f"coverage: {why}")
        if coverage_facts is not None and page is not None:
            out.print(f"page: {full_path(page)}")
        out.print(verdict_text(quality))
        # A log of which no channel was taken needs a signal map.
        is_undescribed = any(not report.channels for report in quality.reports)
        if quality.proposed or (errors and signal_map is None and is_undescribed):
            out.print(
                f"next: edp init {shlex.join(map(str, data))}, which writes a signal map and settings; then edp train "
                "with both"
            )
        elif not errors:
            out.print(f"next: {_training(data, signal_map)}")

    covers = None
    if coverage_facts is not None:
        from edp.data.coverage_targets import wanted

        covers = {**coverage_facts.to_json(), "wanted": [figure.to_json() for figure in wanted(coverage_facts)]}
    emit(as_json, {**quality.to_json(), "coverage": covers, "coverage_absent": why}, show)
    if errors:
        err.print("see the advice beside each error, or ask for a repair with --repair when training")
        raise typer.Exit(FAULTY)


def _training(data: Sequence[Path], signal_map: Path | None) -> str:
    """Return the training command, with the settings of `edp init` if they are next to its map or data-set file."""
    described = signal_map or (data[0] if data[0].suffix == ".toml" else None)
    settings = None if described is None else described.parent / SETTINGS
    mapped = "" if signal_map is None else f" --map {signal_map}"
    command = f"edp train {shlex.join(map(str, data))}{mapped}"
    if settings is None or not is_file_at(settings):
        return f"{command} --out runs/first"
    return f"{command} --config {settings} --out {settings.parent / 'runs' / 'first'}"


def _coverage(source: DataSource, split: str, inputs: tuple[str, ...], asked: bool) -> tuple[Coverage | None, str]:
    """Return the coverage of a source, or the reason why it has none."""
    from edp.workflows.covering import coverage

    try:
        return coverage(source, inputs, split), ""
    except EdpError as error:
        # What was asked for by name must not be missing silently.
        if asked:
            raise
        return None, str(error)


def show_coverage(coverage: Coverage, whole: bool = True) -> None:
    """Print the coverage of a data set; only figures with a target unless `whole`."""
    from edp.report.coverage.page import activity_table, events_table, joints_table, tabulate_targets, together_table

    rows: list[tuple[Any, ...]] = []
    if coverage.singular:
        lags = max(coverage.singular)
        rows.append((f"smallest singular value, {lags} lags", figure(coverage.singular[lags], 3), "white noise: 1"))
    if coverage.spectrum is not None:
        for name, flat, drop in zip(coverage.spectrum.names, coverage.spectrum.flat_to_hz, coverage.spectrum.drop_db):
            rows.append(
                (
                    f"{name}: flat within 10 dB to",
                    f"{figure(flat, 2)} Hz",
                    f"{number(drop, 0)} dB down at {figure(coverage.spectrum.used_hz, 2)} Hz",
                )
            )
    if coverage.occupancy is not None:
        spans = "full strokes" if coverage.occupancy.full_stroke else "range that was seen"
        cells = coverage.occupancy.samples.size
        rows.append(
            (f"cells of {cells} visited", _share(coverage.occupancy.share), f"{coverage.occupancy.source}, {spans}")
        )
    if coverage.distance is not None:
        far = coverage.distance
        rows.append(("test to train, median", figure(far.test[0], 3), f"train to train {figure(far.train[0], 3)}"))
        rows.append(("test farther than 95 % of train", _share(far.beyond), "5 % where both are alike"))
    table(
        f"coverage: {count_of(coverage.recordings, 'recording')}, {number(coverage.hours, 2)} h",
        ["", "value", "note"],
        rows,
    )
    out.print()
    tables = [tabulate_targets(coverage)]
    if whole:
        tables += [make(coverage) for make in (activity_table, together_table, events_table, joints_table)]
    for one in tables:
        if one.rows:
            print_table(one)
            out.print()
    for warning in coverage.contradictions:
        out.print(f"  warning: {warning}")
    for note in coverage.absent:
        out.print(f"  note: {note}")
    out.print()


def _share(value: float | None) -> str:
    return "-" if value is None else percent(value)
