"""A data set described in one TOML file: machine, length, families, soils, sensors, and how the logs are written."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from edp.errors import ConfigError
from edp.settings.tree import SettingsTree, Table
from edp.sim.plan import DataSetSpec
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
    """What a scenario file holds: the data set, and in ``[files]`` how it is written."""

    files: LogFileSettings = field(default_factory=LogFileSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.scenarios()  # refuses machines, sensors and steps that cannot be


SCENARIO_FILE = SettingsTree(what="scenario file")


def read_scenario_file(path: str | Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Values of a scenario file: those of a `DataSetSpec`, and those of its table ``[files]``; only what it states.

    Paths of machine and material files are relative to the scenario file.

    Raises:
        ConfigError: not readable, not TOML, or a key or value that cannot be: file, key, value and bound are named.
    """
    source = Path(path)
    table = _resolved(read_toml(source, f"scenario file {source}", ConfigError), source.parent)
    settings = SCENARIO_FILE.build(ScenarioFile, table, str(source))
    values = {key: getattr(settings, key) for key in table if key != "files"}
    return values, SCENARIO_FILE.plain(settings.files)


def _resolved(table: Table, folder: Path) -> Table:
    """The table with paths of machine and material files that do not depend on the current folder."""
    resolved = dict(table)
    machine, materials = table.get("machine"), table.get("materials")
    if isinstance(machine, str):
        resolved["machine"] = _path(machine, folder)
    if isinstance(materials, dict):
        resolved["materials"] = {_path(name, folder): share for name, share in materials.items()}
    return resolved


def _path(name: str, folder: Path) -> str:
    return str(folder / name) if name.endswith(".toml") else name
