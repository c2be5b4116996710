"""Settings of a command: its table in a settings file with training settings, or ``--set``."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TypeVar

from edp.config.experiment import SETTINGS, Change, Experiment, read_layers
from edp.errors import ConfigError, closest
from edp.settings.bounds import shown
from edp.settings.earlier_keys import earlier
from edp.settings.tree import SettingsTree, merged

TRAINING_TABLES = tuple(entry.name for entry in fields(Experiment))
"""Tables that a command which trains takes beside its own."""
T = TypeVar("T")


def command_settings(
    command: str,
    spec: type[T],
    path: str | Path | None = None,
    overrides: Sequence[Change] = (),
    others: Collection[str] = (),
    tree: SettingsTree = SETTINGS,
) -> tuple[T, tuple[dict[str, object], ...]]:
    """Return the settings of a command from its table in a TOML file, changed by overrides; and the other settings.

    Args:
        command: name of the command and of its table.
        spec: dataclass of the table.
        path: settings file.
        overrides: each ``key.path=value``, or a table; later ones go first.
        others: names of further tables that file and overrides may have.
        tree: reads the table.

    Returns:
        The spec, and the further tables in the order in which they are to be laid over settings.

    Raises:
        ConfigError: names every unknown key, wrong type and impossible value of the command's table at once; a table
            that the command does not take.
    """
    layers = read_layers(path, overrides)
    where = f"[{command}]" + ("" if path is None else f" in '{path}'") + (" with --set" if overrides else "")
    known_tables = (command, *others)
    for key in (key for layer in layers for key in layer):
        if key not in known_tables:
            # A key of the command's own table is easily given without its name.
            own = key in (*(entry.name for entry in fields(spec)), *earlier(spec))  # type: ignore[arg-type]
            hint = f"; did you mean '{command}.{key}'?" if own else closest(key, known_tables)
            raise ConfigError(f"settings {where}: unknown key {shown(key)}{hint}")
    table: dict[str, object] = {}
    for layer in layers:
        entries = layer.get(command)
        present = tree.renamed(spec, entries, command) if isinstance(entries, Mapping) else entries
        table = merged(table, {command: present} if command in layer else {})
    rest = tuple({key: value for key, value in layer.items() if key != command} for layer in layers)
    return tree.build(spec, table.get(command, {}), where, command), tuple(layer for layer in rest if layer)
