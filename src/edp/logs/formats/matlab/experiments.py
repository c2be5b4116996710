"""Several experiments in one variable of a MAT file: a cell of structs, a struct array, an iddata with a cell each."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from edp.logs.formats.matlab.library import MatlabOpaque

_ONE = re.compile(r"(?P<variable>.+)\{(?P<number>[1-9][0-9]{0,5})\}")
"""Pattern of an experiment's name: variable name and number, as in a MATLAB cell index."""
_MIN_ROWS, _MIN_FIELDS = 10, 2
"""Minimum number of common rows of two fields in an experiment, and minimum number of numeric fields. An element with
one field is a channel.
"""


_EACH = ("InputData", "OutputData", "Ts", "Tstart", "SamplingInstants")
"""Fields of an iddata object that are cells with one entry per experiment."""


def experiment_names(variables: Mapping[str, object]) -> list[str]:
    """Return the names of the experiments of all variables that hold several alike: ``train{1}``, ``train{2}``, ..."""
    return [f"{name}{{{i + 1}}}" for name, value in variables.items() for i in range(len(_experiments(value)))]


def pick_experiment(variables: Mapping[str, object], name: str) -> dict[str, object] | None:
    """Return one experiment as a variable; None if no variable has this name."""
    match = _ONE.fullmatch(name)
    if match is None or match["variable"] not in variables:
        return None
    experiments = _experiments(variables[match["variable"]])
    number = int(match["number"])
    return {match["variable"]: experiments[number - 1]} if number <= len(experiments) else None


def _experiments(value: Any) -> list[Any]:
    """Return the experiments of a variable; empty for a single experiment or other content."""
    if isinstance(value, MatlabOpaque):
        return _split_iddata(value)
    if not isinstance(value, np.ndarray) or value.size < 2 or not (value.dtype.names or value.dtype == object):
        return []
    elements = [np.asarray(element) for element in value.ravel(order="F")]
    if value.dtype.names:
        elements = [np.array([[element]], dtype=value.dtype) for element in value.ravel(order="F")]
    alike = all(element.dtype.names == elements[0].dtype.names for element in elements)
    return elements if alike and all(map(_is_experiment, elements)) else []


def _is_experiment(element: Any) -> bool:
    """Return whether a struct holds several signals of the same rows."""
    if not element.dtype.names or element.size != 1:
        return False
    fields = [np.asarray(element.ravel()[0][name]) for name in element.dtype.names]
    rows = [max(field.shape) for field in fields if field.dtype.kind in "fiub" and field.size]
    return any(rows.count(count) >= _MIN_FIELDS for count in rows if count >= _MIN_ROWS)


def _split_iddata(value: MatlabOpaque) -> list[Any]:
    """Return one iddata per experiment of an iddata with several experiments, whose properties are cells."""
    props = value.properties
    if value.classname != "iddata" or not isinstance(props, dict):
        return []
    inner = props.get("Data_")
    parts = (
        [props, inner.properties] if isinstance(inner, MatlabOpaque) and isinstance(inner.properties, dict) else [props]
    )
    cells = [part[key] for part in parts for key in ("InputData", "OutputData") if key in part]
    counts = {cell.size for cell in cells if isinstance(cell, np.ndarray) and cell.dtype == object}
    if len(counts) != 1 or max(counts) < 2:
        return []
    count = max(counts)
    return [_one_iddata(value, i, count) for i in range(count)]


def _one_iddata(value: MatlabOpaque, number: int, count: int) -> MatlabOpaque:
    properties = {}
    for key, entry in value.properties.items():
        if isinstance(entry, MatlabOpaque) and isinstance(entry.properties, dict):
            entry = _one_iddata(entry, number, count)
        elif key in _EACH and isinstance(entry, np.ndarray) and entry.dtype == object and entry.size == count:
            entry = entry.ravel(order="F")[number]
        properties[key] = entry
    return MatlabOpaque(properties, value.classname)
