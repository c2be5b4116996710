"""Signals of a loaded MAT file, in any kind of container.

Known wrappers: vectors and matrices, structs (one time vector per struct), Simulink's structure with time,
``timeseries``, ``Simulink.SimulationData.Dataset`` and ``Signal``, ``SimulationOutput``, signals that Simulink streamed
into the file, ``iddata``, cells, tables and timetables.
"""

from __future__ import annotations

import re
from collections import Counter
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.logs.formats.matlab.library import MatlabOpaque
from edp.logs.formats.matlab.library import pandas as pd
from edp.logs.formats.matlab.sigstream import EVEN_TIMES, VALUES
from edp.logs.formats.matlab.variables import MatVariables, Part

_TIME_FIELDS = ("time_s", "time", "Time", "t", "tout")
_SECONDS = {
    "seconds": 1.0,
    "milliseconds": 1e-3,
    "microseconds": 1e-6,
    "nanoseconds": 1e-9,
    "minutes": 60.0,
    "hours": 3600.0,
    "days": 86400.0,
}


def collect(variables: dict[str, object]) -> MatVariables:
    """Walk all variables; names that occur twice are distinguished by their path (``log.x``)."""
    mat_variables = MatVariables()
    for name, value in variables.items():
        _walk(value, name, name, None, mat_variables)
    _drop_copies(mat_variables)
    short = [part.name for part in mat_variables.signals]
    counts = Counter(short)
    for part in mat_variables.signals:
        if counts[part.name] > 1:
            outer = f"{re.split(r'[.({]', part.path)[0]}.{part.name}"
            part.name = part.path if outer in counts else outer
    counts_now = Counter(part.name for part in mat_variables.signals)
    for name, part in zip(short, mat_variables.signals):
        part.name = part.path if counts_now[part.name] > 1 else part.name
        if counts[name] > 1:
            mat_variables.repeated.setdefault(name, []).append(part.name)
    _share_times(mat_variables)
    return mat_variables


def _drop_copies(mat_variables: MatVariables) -> None:
    """Remove repeated signals of equal name, which a model logs at each block along a line."""
    parts_by_name: dict[str, list[Part]] = {}
    for part in mat_variables.signals:
        namesakes = parts_by_name.setdefault(part.name, [])
        if not any(_is_copy(part, other) for other in namesakes):
            namesakes.append(part)
    staying = {id(part) for parts in parts_by_name.values() for part in parts}
    mat_variables.signals = [part for part in mat_variables.signals if id(part) in staying]


def _is_copy(part: Part, other: Part) -> bool:
    """Return whether two signals have the same values at the same times of their own, and one unit."""
    if part.time is None or other.time is None or part.unit != other.unit:
        return False
    return np.array_equal(part.time, other.time) and np.array_equal(
        part.values, other.values, equal_nan=part.values.dtype.kind == "f" and other.values.dtype.kind == "f"
    )


def _share_times(mat_variables: MatVariables) -> None:
    """Replace equal time arrays by one array.

    A Dataset holds one per signal, and each would be checked and stored again.
    """
    distinct_times: list[NDArray[np.float64]] = []
    for part in mat_variables.signals:
        if part.time is None:
            continue
        same = next((time for time in distinct_times if time is part.time or np.array_equal(time, part.time)), None)
        if same is None:
            distinct_times.append(part.time)
        else:
            part.time = same


def _walk(value: Any, name: str, path: str, time: NDArray[np.float64] | None, mat_variables: MatVariables) -> None:
    if isinstance(value, MatlabOpaque):
        _walk_object(value, name, path, mat_variables)
    elif isinstance(value, pd.DataFrame):
        _walk_table(value, path, mat_variables)
    elif isinstance(value, np.ndarray) and value.dtype.names:
        _walk_struct(value, path, mat_variables)
    elif isinstance(value, np.ndarray) and value.dtype == object:
        for i, item in enumerate(value.ravel(order="F")):
            inner = f"{name}_{i + 1}" if value.size > 1 else name
            _walk(item, inner, f"{path}{{{i + 1}}}" if value.size > 1 else path, time, mat_variables)
    elif isinstance(value, np.ndarray | np.generic) and np.asarray(value).dtype.kind in "fiub":
        _add_array(np.asarray(value), name, path, time, mat_variables)


def _add_array(
    array: NDArray[Any],
    name: str,
    path: str,
    time: NDArray[np.float64] | None,
    mat_variables: MatVariables,
    unit: str | None = None,
) -> None:
    # A single number without a time is a gain or a constant, no signal.
    if array.size == 1 and time is None:
        mat_variables.scalars[name] = float(array.ravel()[0])
        return
    columns = _columns(array, None if time is None else len(time))
    if columns is None:
        return
    column_time = time if time is not None and len(time) == columns.shape[0] else None
    for i in range(columns.shape[1]):
        ending = f"_{i + 1}" if columns.shape[1] > 1 else ""
        mat_variables.signals.append(Part(name + ending, columns[:, i], column_time, unit, path + ending))


def _columns(array: NDArray[Any], samples: int | None) -> NDArray[Any] | None:
    """Return an array as ``(time, column)``.

    Time is the axis with `samples` values, otherwise the longest; None without one.
    """
    if array.size == 0:
        return None
    long_sides = [length for length in array.shape if length > 1]
    if len(long_sides) <= 1:
        return array.reshape(-1, 1)
    fitting = [axis for axis, length in enumerate(array.shape) if length == samples]
    axis = fitting[0] if fitting else int(np.argmax(array.shape))
    if array.ndim > 2 and not fitting:
        return None
    # Simulink logs vectors as (1, 1, time) or (column, time) as well.
    moved = np.moveaxis(array, axis, 0)
    return moved.reshape(moved.shape[0], -1)


def _walk_struct(value: NDArray[Any], path: str, mat_variables: MatVariables) -> None:
    fields = value.dtype.names or ()
    for number, element in enumerate(value.ravel(order="F")):
        here = f"{path}({number + 1})" if value.size > 1 else path
        if {VALUES, EVEN_TIMES} <= set(fields):
            _add_streamed(element, fields, here, mat_variables)
            continue
        if {"BlockPath", "PortIndex", "Values"} <= set(fields):
            # The block tells signals of one name apart.
            _walk(
                element["Values"],
                _text(element["Name"]) if "Name" in fields else "",
                _port(element, here),
                None,
                mat_variables,
            )
            continue
        if "signals" in fields and "time" in fields:
            _walk_structure_with_time(element, here, mat_variables)
            continue
        time = _struct_time(element, fields)
        for name in fields:
            if time is not None and name == time[0]:
                continue
            _walk(element[name], name, f"{here}.{name}", time[1] if time else None, mat_variables)


def _struct_time(element: Any, fields: tuple[str, ...]) -> tuple[str, NDArray[np.float64]] | None:
    for name in _TIME_FIELDS:
        if name in fields and isinstance(element[name], np.ndarray) and element[name].dtype.kind in "fiu":
            stamps = element[name].ravel().astype(np.float64)
            # A single number called time is no clock.
            if len(stamps) > 1:
                return name, stamps
    return None


def _walk_structure_with_time(element: Any, path: str, mat_variables: MatVariables) -> None:
    """Read Simulink's 'Structure with time': fields time and signals(k).values, signals(k).label."""
    stamps = np.asarray(element["time"], dtype=np.float64).ravel()
    signals = element["signals"]
    if not isinstance(signals, np.ndarray) or not signals.dtype.names or "values" not in signals.dtype.names:
        return
    for number, signal in enumerate(signals.ravel(order="F")):
        label = _text(signal["label"]) if "label" in signals.dtype.names else ""
        name = label or f"signal_{number + 1}"
        time = stamps if len(stamps) > 1 else None
        _add_array(np.asarray(signal["values"]), name, f"{path}.{name}", time, mat_variables)


def _add_streamed(element: Any, fields: tuple[str, ...], path: str, mat_variables: MatVariables) -> None:
    """Add a Dataset signal with the values from `edp.logs.formats.matlab.sigstream`."""
    values, time = element[VALUES], element[EVEN_TIMES]
    if not isinstance(values, np.ndarray) or values.ndim != 2 or time is None:
        return
    units = [_find_text(element[key]) if key in fields else "" for key in ("TimeUnits", "DataUnits")]
    seconds = np.asarray(time, dtype=np.float64) * _SECONDS.get(units[0].lower(), 1.0)
    name = (_text(element["Name"]) if "Name" in fields else "") or path.rpartition(".")[2]
    _add_array(values, name, path, seconds, mat_variables, units[1] or None)


def _port(element: Any, path: str) -> str:
    """Return block and port at which a Dataset signal was logged; `path` if they are not named."""
    block = element["BlockPath"]
    while isinstance(block, np.ndarray) and block.dtype == object and block.size:
        block = block.ravel()[0]
    port = _number(element["PortIndex"])
    return f"{_text(block)}:{1 if port is None else port:.0f}" if _text(block) else path


def _find_text(value: Any) -> str:
    """Return the text in the ``Value`` field of a struct, or the text itself."""
    if isinstance(value, np.ndarray) and value.dtype.names and "Value" in value.dtype.names and value.size:
        return _text(value.ravel()[0]["Value"])
    return _text(value)


def _walk_table(table: pd.DataFrame, path: str, mat_variables: MatVariables) -> None:
    time = None
    if isinstance(table.index, pd.TimedeltaIndex | pd.DatetimeIndex):
        index = table.index.to_numpy()
        first = index[:1] if isinstance(table.index, pd.DatetimeIndex) else np.zeros(1, dtype=index.dtype)
        time = np.asarray((index - first) / np.timedelta64(1, "s"), dtype=np.float64)
    units = table.attrs.get("varUnits") or table.attrs.get("VariableUnits") or []
    for i, name in enumerate(table.columns):
        values = table[name].to_numpy()
        if values.dtype.kind in "fiub" and len(values):
            unit = str(units[i]) if i < len(units) else None
            mat_variables.signals.append(Part(str(name), values, time, unit, f"{path}.{name}"))


def _walk_object(value: MatlabOpaque, name: str, path: str, mat_variables: MatVariables) -> None:
    props = value.properties
    if not isinstance(props, dict):
        return
    if value.classname == "timeseries" or {"Data_", "TimeInfo"} <= set(props):
        _add_timeseries(props, name, path, mat_variables)
    elif value.classname == "iddata":
        _add_iddata(props, mat_variables)
    elif "Values" in props:
        _walk(props["Values"], _text(props.get("Name")) or name, path, None, mat_variables)
    else:
        # Where MATLAB's classes keep what they hold, from saved objects to plain containers.
        for key in ("any", "Storage", "Elements", "Data"):
            if key in props:
                _walk_contents(props[key], name, path, mat_variables)


def _walk_contents(value: Any, name: str, path: str, mat_variables: MatVariables) -> None:
    """Visit the content of a Dataset or SimulationOutput: structs with Storage or Elements, cells, or plain fields."""
    if isinstance(value, np.ndarray) and value.dtype.names and {"Storage", "Elements"} & set(value.dtype.names):
        for element in value.ravel():
            for key in ("Storage", "Elements"):
                if key in value.dtype.names:
                    _walk(element[key], name, path, None, mat_variables)
    else:
        _walk(value, name, path, None, mat_variables)


def _add_timeseries(props: dict[str, object], name: str, path: str, mat_variables: MatVariables) -> None:
    data = np.asarray(props.get("Data_", np.empty(0)))
    if data.dtype.kind not in "fiub" or data.size == 0:
        return
    time = _timeseries_time(props)
    unit = _timeseries_unit(props.get("DataInfo"))
    series_name = _text(props.get("Name"))
    _add_array(data, series_name if series_name and series_name != "unnamed" else name, path, time, mat_variables, unit)


def _add_iddata(props: dict[str, object], mat_variables: MatVariables) -> None:
    """Add inputs and outputs of System Identification Toolbox data under their names there."""
    inner = props.get("Data_")
    facts = props | (inner.properties if isinstance(inner, MatlabOpaque) and isinstance(inner.properties, dict) else {})
    factor = _SECONDS.get(_text(facts.get("TimeUnit_")).lower(), 1.0)
    stamps, step = np.asarray(facts.get("SamplingInstants", np.empty(0))), _number(facts.get("Ts"))
    start = _number(facts.get("Tstart"))
    for part in ("Input", "Output"):
        data = np.asarray(facts.get(f"{part}Data", np.empty(0)))
        if data.dtype == object:
            # A cell an experiment, each with a time of its own.
            mat_variables.experiments = max(mat_variables.experiments, data.size)
            continue
        if data.dtype.kind not in "fiub" or data.ndim != 2 or not len(data):
            continue
        time = stamps.ravel() * factor if stamps.dtype.kind == "f" and stamps.size == len(data) else None
        if time is None and step is not None and step > 0:
            time = _even(start or 0.0, step, len(data), factor)
        names, units = (_texts(facts.get(f"{part}{what}_")) for what in ("Name", "Unit"))
        for i in range(data.shape[1]):
            name = names[i] if i < len(names) and names[i] else f"{part.lower()}_{i + 1}"
            unit = units[i] if i < len(units) else ""
            mat_variables.signals.append(Part(name, data[:, i], time, unit or None, f"{part.lower()}.{name}"))


def _texts(value: Any) -> list[str]:
    return [_text(item) for item in np.asarray(value if value is not None else np.empty(0)).ravel()]


def _timeseries_time(props: dict[str, object]) -> NDArray[np.float64] | None:
    """Time in seconds: its own vector, else start, increment and length."""
    info = props.get("TimeInfo")
    facts = info.properties if isinstance(info, MatlabOpaque) and isinstance(info.properties, dict) else {}
    factor = _SECONDS.get(_text(facts.get("Units")).lower(), 1.0)
    for source in (props.get("Time_"), facts.get("Time_")):
        if source is not None and np.asarray(source).size:
            return np.asarray(source, dtype=np.float64).ravel() * factor
    start, step, length = (_number(facts.get(key)) for key in ("Start_", "Increment_", "Length"))
    if step is None or length is None:
        return None
    return _even(start or 0.0, step, int(length), factor)


@lru_cache(maxsize=1)
def _even(start: float, step: float, length: int, factor: float) -> NDArray[np.float64]:
    """Return evenly spaced times; all signals of a Dataset use the same array."""
    return np.asarray((start + step * np.arange(length)) * factor, dtype=np.float64)


def _timeseries_unit(info: Any) -> str:
    facts = info.properties if isinstance(info, MatlabOpaque) and isinstance(info.properties, dict) else {}
    units = facts.get("Units")
    if isinstance(units, MatlabOpaque) and isinstance(units.properties, dict):
        units = units.properties.get("Name")
    return _text(units)


def _text(value: Any) -> str:
    array = np.asarray(value) if value is not None else np.empty(0)
    return str(array.ravel()[0]) if array.size and array.dtype.kind in "UTO" else ""


def _number(value: Any) -> float | None:
    array = np.asarray(value) if value is not None else np.empty(0)
    return float(array.ravel()[0]) if array.size and array.dtype.kind in "fiu" else None
