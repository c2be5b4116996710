"""A data set described in one TOML file: machine, length, families, soils, sensors, and how the logs are written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import Any, get_type_hints

from edp.errors import ConfigError
from edp.settings.tree import SettingsTree, combined, merged, override
from edp.sim.plan import DataSetSpec
from edp.sim.predictability import LimitSpec
from edp.storage import read_toml


@dataclass(frozen=True)
class LogFileSettings:
    """The table ``[files]``: how the logs are written; None is as `edp.sim.data_set.SimulationOrder` has it.

    Attributes:
        format: name of a log format, such as ``parquet``.
        layout: layout of MAT files.
        truth: where the channels go that only a simulation knows.
    """

    format: str | None = None
    layout: str | None = None
    truth: str | None = None


@dataclass(frozen=True, kw_only=True)
class ScenarioFile(DataSetSpec):
    """Content of a scenario file: data set, write options in ``[files]``, limit settings in ``[limit]``.

    Attributes:
        files: format, layout and truth of the files that are written.
        limit: settings of the limit of predictability.
    """

    files: LogFileSettings = field(default_factory=LogFileSettings)
    limit: LimitSpec = field(default_factory=LimitSpec)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.scenarios()  # refuses machines, sensors and steps that cannot be


SCENARIO_FILE = SettingsTree(what="scenario file")
_HINTS = get_type_hints(ScenarioFile)
_CHANGES = make_dataclass("ScenarioChanges", [(entry.name, _HINTS[entry.name], None) for entry in fields(ScenarioFile)])
"""Some keys of a scenario file, without the checks of what belongs together: the file may hold the rest."""


def read_scenario_file(path: str | Path) -> dict[str, object]:
    """Read the stated values of a scenario file, by the attributes of `edp.sim.data_set.SimulationOrder`.

    Paths of machine and material files are relative to the scenario file.

    Raises:
        ConfigError: not readable, not TOML, or a key or value that cannot be: file, key, value and bound are named.
    """
    table = _table(path)
    settings = SCENARIO_FILE.build(ScenarioFile, table, str(path))
    return _split_settings(settings, table)


def scenario_changes(overrides: Sequence[str]) -> dict[str, object]:
    """Return the values of ``key.path=value`` overrides of a scenario file, in the form of `read_scenario_file`.

    Raises:
        ConfigError: a key that a scenario file does not have, or a value of another kind.
    """
    table = _merge_overrides(overrides)
    return _split_settings(SettingsTree().build(_CHANGES, table, "--set"), table)


def limit_settings(path: str | Path | None, overrides: Sequence[str]) -> LimitSpec:
    """Return the limit settings: the table ``[limit]`` of a scenario file, changed by overrides.

    Raises:
        ConfigError: a key or value that cannot be.
    """
    table = merged({} if path is None else _table(path), _merge_overrides(overrides))
    return SettingsTree().build(LimitSpec, table.get("limit", {}), "[limit]", "limit")


def _table(path: str | Path) -> dict[str, object]:
    source = Path(path)
    return _resolve_paths(read_toml(source, f"scenario file {source}", ConfigError), source.parent)


def _merge_overrides(overrides: Sequence[str]) -> dict[str, object]:
    return combined([override(text) for text in overrides])


def suffix_of(form: str) -> str:
    """Return ``parquet`` or ``.parquet`` to ``.parquet``."""
    return f".{form.lstrip('.')}"


def _split_settings(settings: Any, table: Mapping[str, object]) -> dict[str, object]:
    """Return the stated values of the data set and of the write options."""
    values = {key: getattr(settings, key) for key in table if key not in ("files", "limit")}
    files = {} if settings.files is None else SCENARIO_FILE.to_dict(settings.files)
    if "format" in files:
        files["suffix"] = suffix_of(files.pop("format"))
    return values | files


def _resolve_paths(table: Mapping[str, object], folder: Path) -> dict[str, object]:
    """Return the table with absolute paths of machine and material files."""
    resolved = dict(table)
    machine, materials = table.get("machine"), table.get("materials")
    if isinstance(machine, str):
        resolved["machine"] = _path(machine, folder)
    if isinstance(materials, dict):
        resolved["materials"] = {_path(name, folder): share for name, share in materials.items()}
    return resolved


def _path(name: str, folder: Path) -> str:
    return str(folder / name) if name.endswith(".toml") else name
