"""Layouts of a recording in a MAT file, one entry per layout."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from edp.recording import Recording
from edp.registry import Registry

if TYPE_CHECKING:
    from edp.logs.formats.matlab.library import MatlabOpaque

_DATASET = "Simulink.SimulationData.Dataset"
_STORAGE = "Simulink.SimulationData.Storage.RamDatasetStorage"


@dataclass(frozen=True)
class MatLayout:
    """Conversion of a recording to MATLAB variables.

    Attributes:
        build: makes the value of `variable`.
        saveobj_classes: classes that MATLAB saves through ``saveobj``.
        variable: name of the variable.
        stamps: name of a variable with the time in s; empty for none.
    """

    build: Callable[[Recording], Any]
    saveobj_classes: tuple[str, ...] = ()
    variable: str = "log"
    stamps: str = ""

    def variables(self, recording: Recording) -> dict[str, object]:
        """Return the variables of a file."""
        mat_values = {self.variable: self.build(recording)}
        return mat_values | {self.stamps: _time(recording)} if self.stamps else mat_values


LAYOUTS: Registry[MatLayout] = Registry("MAT layout")


def _struct(recording: Recording) -> Any:
    """Return a struct of column vectors: ``log.time`` in seconds and one field per channel in SI units."""
    fields: dict[str, object] = {"time": _time(recording)}
    for name in recording.channel_names:
        fields[name] = np.ascontiguousarray(recording.column(name)).reshape(-1, 1)
    return fields


def _object(classname: str, **properties: Any) -> MatlabOpaque:
    from edp.logs.formats.matlab.library import MatlabOpaque

    return MatlabOpaque(properties=properties, classname=classname)


def _time(recording: Recording) -> Any:
    return (np.arange(recording.samples) / recording.rate_hz).reshape(-1, 1)


def _one_timeseries(recording: Recording, name: str, unit: str, values: Any) -> MatlabOpaque:
    empty = np.empty((0, 0))
    return _object(
        "timeseries",
        Name=np.array([name]),
        DataInfo=_object("tsdata.datametadata", Units=np.array([unit])),
        TimeInfo=_object(
            "tsdata.timemetadata",
            Units=np.array(["seconds"]),
            Length=np.array([[float(recording.samples)]]),
            Time_=empty,
            Increment_=np.array([[1.0 / recording.rate_hz]]),
            Start_=np.array([[0.0]]),
        ),
        Data_=values,
        Time_=empty,
        IsTimeFirst_=np.array([[True]]),
    )


def _timeseries(recording: Recording) -> Any:
    """Return a struct with one ``timeseries`` per channel."""
    return {name: _one_timeseries(recording, name, *rest) for name, *rest in _columns(recording)}


def _dataset(recording: Recording) -> Any:
    """Return a ``Simulink.SimulationData.Dataset`` of ``timeseries``."""
    return _dataset_of(recording, _columns(recording))


def _logsout(recording: Recording) -> Any:
    """Return a Dataset with the vector signals that a model logs: ``CylVels`` has three columns."""
    return _dataset_of(recording, _vectors(recording))


def _vector_struct(recording: Recording) -> Any:
    """Return a struct with ``time`` in seconds and one field per signal; vectors are matrices."""
    return {"time": _time(recording)} | {name: values for name, _, values in _vectors(recording)}


def _columns(recording: Recording) -> list[tuple[str, str, Any]]:
    """Name, unit and column vector of each channel."""
    return [
        (channel.name, channel.unit, np.ascontiguousarray(recording.values[:, [i]]))
        for i, channel in enumerate(recording.channels)
    ]


def _vectors(recording: Recording) -> list[tuple[str, str, Any]]:
    """Return the columns like `_columns`, with ``name_1``, ``name_2``, ... for the columns of ``name``.

    A column without a channel (``CylPressures_4``, the swing) is NaN.
    """
    groups: dict[tuple[str, str], dict[int, int]] = {}
    for i, channel in enumerate(recording.channels):
        match = re.fullmatch(r"(.+)_([1-9]\d*)", channel.name)
        key, row_index = (channel.name, 0) if match is None else (match[1], int(match[2]))
        groups.setdefault((key, channel.unit), {})[row_index] = i
    keys = [key for key, _ in groups]
    columns: list[tuple[str, str, Any]] = []
    for (key, unit), places in groups.items():
        width = max(places)
        # At most half of the columns may be missing: names such as step_1 and step_1000 are no vector.
        if 1 in places and len(places) > 1 and 0 not in places and keys.count(key) == 1 and width <= 2 * len(places):
            values = np.full((recording.samples, width), np.nan, dtype=np.float32)
            for row_index, i in places.items():
                values[:, row_index - 1] = recording.values[:, i]
            columns.append((key, unit, values))
        else:
            chosen = sorted(places.values())
            columns += [column for i, column in enumerate(_columns(recording)) if i in chosen]
    return columns


def _dataset_of(recording: Recording, signals: list[tuple[str, str, Any]]) -> Any:
    elements = np.empty((1, len(signals)), dtype=object)
    for i, (name, unit, values) in enumerate(signals):
        elements[0, i] = _one_timeseries(recording, name, unit, values)
    storage = _save_object(_STORAGE, {"Version": np.array([[2.0]]), "Elements": elements})
    return _save_object(_DATASET, {"Name": np.array([""]), "Version": np.array([[3.0]]), "Storage": storage})


def _save_object(classname: str, fields: dict[str, object]) -> MatlabOpaque:
    """Return an object as its ``saveobj`` stores it: a single property ``any`` with a struct."""
    struct = np.empty((1, 1), dtype=[(name, object) for name in fields])
    for name, value in fields.items():
        struct[0, 0][name] = value
    return _object(classname, any=struct)


def _timetable(recording: Recording) -> Any:
    """Return a ``timetable`` with one variable per channel."""
    from edp.logs.formats.matlab.library import pandas as pd

    # Whole nanoseconds, as pandas counts durations, which are the row times of a timetable.
    stamps = np.rint(np.arange(recording.samples) * (1e9 / recording.rate_hz)).astype("timedelta64[ns]")
    columns = {name: np.ascontiguousarray(recording.column(name)) for name in recording.channel_names}
    return pd.DataFrame(columns, index=pd.TimedeltaIndex(stamps, name="Time"))


LAYOUTS.register("struct")(MatLayout(_struct))
LAYOUTS.register("timeseries")(MatLayout(_timeseries))
LAYOUTS.register("dataset")(MatLayout(_dataset, (_DATASET, _STORAGE)))
LAYOUTS.register("timetable")(MatLayout(_timetable))
LAYOUTS.register("simulink")(MatLayout(_logsout, (_DATASET, _STORAGE), variable="logsout", stamps="tout"))
LAYOUTS.register("speedgoat")(MatLayout(_vector_struct, variable="data"))
