"""The files of an exported controller that come from this package and from the C runtime of models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import resources

from edp.export.c.model import Model
from edp.export.escape import Code


def own_file(path: str) -> str:
    """Text of a file below this package."""
    return resources.files("edp.export.controller").joinpath(path).read_text(encoding="utf-8")


def c_runtime(file: str) -> str:
    """Text of a file of the runtime that every exported model has."""
    return resources.files("edp.export.c").joinpath(f"runtime/{file}").read_text(encoding="utf-8")


def model_files(
    name: str, filled: Callable[[str], Code], template: str, model: Model, runtime: Sequence[str]
) -> dict[str, str]:
    """Model and runtime of a plan by file name.

    Args:
        name: C prefix.
        filled: fills a template of this package.
        template: name of the template of header and source, without its ending.
        model: the layers.
        runtime: files of this package that the model needs beside its own.
    """
    texts: dict[str, str] = {f"{name}.{end}": filled(f"{template}.{end}.in") for end in ("h", "c")}
    texts[f"{name}_weights.h"] = model.weights()
    texts |= {file: c_runtime(file) for file in model.runtime}
    return texts | {file: own_file(f"runtime/{file}") for file in runtime}
