"""``edp compress quantise``: a trained network in integers (W8A16)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from edp.cli.console import JsonFlag, emit, out
from edp.wording import number, percent


def quantise(
    run: Annotated[Path, typer.Argument(help="Run folder of edp train, edp compress distil or edp compress search.")],
    folder: Annotated[Path, typer.Option("--out", help="Folder of the new run.")],
    calibration_samples: Annotated[
        int,
        typer.Option(min=1000, max=100_000_000, help="Number of calibration samples for number formats and weights."),
    ] = 20_000,
    as_json: JsonFlag = False,
) -> None:
    """Write a run with 8-bit weights and 16-bit values: evaluate, report and export then use integer arithmetic.

    Example: `edp compress quantise runs/first --out runs/first_w8a16`
    """
    from edp.workflows.compression.quantise import quantise as make

    result = make(run, folder, calibration_samples)

    def show() -> None:
        change = percent(result["integer"] / result["float"] - 1.0, signed=True)
        out.print(
            f"error on the validation part: {change} against float32; constants {number(result['bytes'], 0)} bytes"
        )
        out.print(f"next: edp evaluate {folder}, edp export {folder} --format c --out firmware/predictor")

    emit(as_json, {"folder": str(folder), **result}, show)
