"""A data set described in one TOML file: machine, length, families, soils, sensors, and how the logs are written."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from edp.errors import ConfigError, closest
from edp.sim.machine.family import WIDEST
from edp.sim.plan import MOST_MACHINES, MOST_MINUTES, MOST_RECORDINGS, MOST_SEED, DataSetSpec
from edp.storage import read_toml

FILE_KEYS = ("format", "layout", "truth")
WHOLE = {"recordings": (1, MOST_RECORDINGS), "seed": (0, MOST_SEED - 1), "family": (0, MOST_MACHINES)}
NUMBERS = {"minutes": (0.0, MOST_MINUTES), "rate_hz": (1.0, 1000.0), "step_s": (0.0, 2.5e-3), "scatter": (0.0, WIDEST)}
"""Bounds; the lower one of numbers itself is not allowed where it is 0."""
TABLES = ("mix", "materials", "sensors")


def read_scenario_file(path: str | Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Values of a scenario file: those of a `DataSetSpec`, and those of its table ``[files]``.

    Paths of machine and material files are relative to the scenario file.

    Raises:
        ConfigError: not readable, not TOML, or a key or value that cannot be: file, key, value and bound are named.
    """
    source = Path(path)
    where = f"scenario file {source}"
    table = read_toml(source, where, ConfigError)
    known = [entry.name for entry in fields(DataSetSpec)]
    for key in table:
        if key not in (*known, "files"):
            raise ConfigError(f"{where}: unknown key '{key}'{closest(key, (*known, 'files'))}")
    files = dict(_table(table.pop("files", {}), f"{where} [files]"))
    for key, value in files.items():
        if key not in FILE_KEYS:
            raise ConfigError(f"{where} [files]: unknown key '{key}'{closest(key, FILE_KEYS)}")
        if not isinstance(value, str):
            raise ConfigError(f"{where} [files]: {key} = {value!r} must be a text")
    values = {key: _value(key, value, where, source.parent) for key, value in table.items()}
    try:
        DataSetSpec(**values).scenarios()
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
    return values, files


def _value(key: str, value: Any, where: str, folder: Path) -> Any:
    if key in WHOLE:
        low, high = WHOLE[key]
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise ConfigError(f"{where}: {key} = {value!r} must be a whole number from {low} to {high}")
    elif key in NUMBERS:
        first, last = NUMBERS[key]
        if not _number(value) or not (first < value if first == 0.0 else first <= value) or value > last:
            bound = f"above 0 and at most {last:g}" if first == 0.0 else f"from {first:g} to {last:g}"
            raise ConfigError(f"{where}: {key} = {value!r} must be a number {bound}")
    elif key in TABLES:
        shares = _table(value, f"{where} [{key}]")
        return {_path(name, folder) if key == "materials" else name: share for name, share in shares.items()}
    elif key == "sensor_noise":
        if not isinstance(value, bool):
            raise ConfigError(f"{where}: sensor_noise = {value!r} must be true or false")
    elif key == "masses":
        if not (isinstance(value, list) and len(value) == 2 and all(_number(v) for v in value)):
            raise ConfigError(f"{where}: masses = {value!r} must be [lightest, heaviest], t")
        return tuple(map(float, value))
    elif key == "start_strokes":
        if not (isinstance(value, list) and len(value) == 2 and all(_number(v) and 0 <= v <= 1 for v in value)):
            raise ConfigError(f"{where}: start_strokes = {value!r} must be [low, high], shares from 0 to 1")
        return tuple(value)
    elif not isinstance(value, str):
        raise ConfigError(f"{where}: {key} = {value!r} must be a text")
    return _path(value, folder) if key == "machine" else value


def _table(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f"{where}: is {value!r}, expected a table")
    return value


def _path(name: str, folder: Path) -> str:
    return str(folder / name) if name.endswith(".toml") else name


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
