"""How a recording is laid out in a MAT file; one entry a layout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from edp.logs.matlab import MatlabOpaque
from edp.logs.matlab import pandas as pd
from edp.recording import Recording
from edp.registry import Registry

INFO = "edp_info"
_DATASET = "Simulink.SimulationData.Dataset"
_STORAGE = "Simulink.SimulationData.Storage.RamDatasetStorage"


@dataclass(frozen=True)
class Layout:
    """Builds the value of the variable ``log``; classes that MATLAB saves through ``saveobj`` are named."""

    build: Callable[[Recording], Any]
    saveobj_classes: tuple[str, ...] = ()


LAYOUTS: Registry[Layout] = Registry("MAT layout")


def _struct(recording: Recording) -> Any:
    """A struct of column vectors, ``log.time`` in seconds and one field per channel in SI units."""
    fields: dict[str, Any] = {"time": (np.arange(recording.samples) / recording.rate_hz).reshape(-1, 1)}
    for name in recording.channel_names:
        fields[name] = np.ascontiguousarray(recording.column(name)).reshape(-1, 1)
    return fields


def _object(classname: str, **properties: Any) -> MatlabOpaque:
    return MatlabOpaque(properties=properties, classname=classname)


def _one_timeseries(recording: Recording, position: int) -> MatlabOpaque:
    channel = recording.channels[position]
    empty = np.empty((0, 0))
    return _object(
        "timeseries",
        Name=np.array([channel.name]),
        DataInfo=_object("tsdata.datametadata", Units=np.array([channel.unit])),
        TimeInfo=_object(
            "tsdata.timemetadata",
            Units=np.array(["seconds"]),
            Length=np.array([[float(recording.samples)]]),
            Time_=empty,
            Increment_=np.array([[1.0 / recording.rate_hz]]),
            Start_=np.array([[0.0]]),
        ),
        Data_=np.ascontiguousarray(recording.values[:, position]).reshape(-1, 1),
        Time_=empty,
        IsTimeFirst_=np.array([[True]]),
    )


def _timeseries(recording: Recording) -> Any:
    """A struct with one ``timeseries`` per channel."""
    return {name: _one_timeseries(recording, i) for i, name in enumerate(recording.channel_names)}


def _dataset(recording: Recording) -> Any:
    """A ``Simulink.SimulationData.Dataset`` of ``timeseries``."""
    elements = np.empty((1, len(recording.channels)), dtype=object)
    for i in range(len(recording.channels)):
        elements[0, i] = _one_timeseries(recording, i)
    storage = _saved(_STORAGE, {"Version": np.array([[2.0]]), "Elements": elements})
    return _saved(_DATASET, {"Name": np.array([""]), "Version": np.array([[3.0]]), "Storage": storage})


def _saved(classname: str, fields: dict[str, Any]) -> MatlabOpaque:
    """An object as its ``saveobj`` leaves it: a single property ``any`` that holds a struct."""
    struct = np.empty((1, 1), dtype=[(name, object) for name in fields])
    for name, value in fields.items():
        struct[0, 0][name] = value
    return _object(classname, any=struct)


def _timetable(recording: Recording) -> Any:
    """A ``timetable`` with one variable per channel."""
    stamps = np.rint(np.arange(recording.samples) * (1e9 / recording.rate_hz)).astype("timedelta64[ns]")
    columns = {name: np.ascontiguousarray(recording.column(name)) for name in recording.channel_names}
    return pd.DataFrame(columns, index=pd.TimedeltaIndex(stamps, name="Time"))


LAYOUTS.register("struct")(Layout(_struct))
LAYOUTS.register("timeseries")(Layout(_timeseries))
LAYOUTS.register("dataset")(Layout(_dataset, (_DATASET, _STORAGE)))
LAYOUTS.register("timetable")(Layout(_timetable))
