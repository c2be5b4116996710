"""``edp inspect``: what is in a log and what is wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from edp.cli.console import JsonFlag, emit, err, out, table
from edp.cli.train import MapOption

FAULTY = 3


def inspect(
    data: Annotated[Path, typer.Argument(help="A log, a folder of logs, or a data-set file (.toml).")],
    signal_map: MapOption = None,
    channels: Annotated[bool, typer.Option(help="Show a row for each channel.")] = True,
    as_json: JsonFlag = False,
) -> None:
    """Report rate, gaps, missing values, constant channels and doubtful units of recordings; nothing is changed.

    Ends with exit code 3 where a log has an error that training would refuse.

    Example: `edp inspect logs/ --map mine.toml`
    """
    from edp.sources import DataSource

    plain = [report.to_json() for report in DataSource.of(data, signal_map).inspect()]
    errors = sum(finding["severity"] == "error" for report in plain for finding in report["findings"])

    def show() -> None:
        for report in plain:
            show_report(report, channels)
        verdict = f"{errors} error(s) that training would refuse" if errors else "no errors"
        out.print(f"{len(plain)} recording(s), {verdict}")
        if not errors:
            mapped = "" if signal_map is None else f" --map {signal_map}"
            out.print(f"next: edp train {data}{mapped} --out runs/first")

    emit(as_json, {"errors": errors, "recordings": plain}, show)
    if errors:
        err.print("see the advice beside each error, or ask for a repair with --repair when training")
        raise typer.Exit(FAULTY)


def show_report(report: dict[str, Any], channels: bool) -> None:
    """Print one recording's facts and findings."""
    rate = report["rate_hz"]
    head = f"{report['name']}: {report['duration_s']:.1f} s, {rate:g} Hz, {report['samples']:,} samples"
    if channels:
        rows = [
            (c["name"], c["kind"], c["unit"], *(_short(c[key]) for key in ("min", "max", "mean", "std")), c["missing"])
            for c in report["channels"]
        ]
        table(head, ["channel", "kind", "unit", "min", "max", "mean", "std", "missing"], rows)
    else:
        out.print(head)
    for finding in report["findings"]:
        where = f" {finding['channel']}:" if finding["channel"] else ""
        place = f" ({finding['where']})" if finding["where"] else ""
        out.print(f"  {finding['severity']}:{where} {finding['what']}{place}. {finding['advice']}")
    out.print()


def _short(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
