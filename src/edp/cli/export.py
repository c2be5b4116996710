"""``edp export``: a trained network in a form that runs without EDP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from edp.cli.console import JsonFlag, emit, out


def export(
    bundle: Annotated[Path, typer.Argument(help="Bundle, or run folder of edp train.")],
    to: Annotated[str, typer.Option(help="Form: c (C99 for controllers) or onnx.")],
    folder: Annotated[Path, typer.Option("--out", help="Folder for the files; those of the same names are replaced.")],
    name: Annotated[str, typer.Option(help="What the network is called there.")] = "predictor",
    opset: Annotated[int | None, typer.Option(help="Of onnx: version of the operators (default 13).")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Write a trained network in a form that runs without EDP; it reads and gives SI units.

    Example: `edp export runs/first --to c --out firmware/predictor`
    """
    from edp.workflow import export_bundle

    files = export_bundle(bundle, to, folder, name, {} if opset is None else {"opset": opset})

    def show() -> None:
        for file in files:
            out.print(str(file))
        out.print(f"written: {files[0].parent.resolve()}; read {files[0].name} first")
        if (files[0].parent / "CMakeLists.txt").is_file():
            where, build = files[0].parent, files[0].parent / "build"
            out.print(f"next: cmake -S {where} -B {build} && cmake --build {build} && ctest --test-dir {build}")

    emit(as_json, {"to": to, "name": name, "files": [str(file) for file in files]}, show)
