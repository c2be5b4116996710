"""Result files: one frozen dataclass for each JSON file of a run, written in its form and checked when it is read."""

from __future__ import annotations

import math
import typing
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Self

from edp.errors import ConfigError, StorageError
from edp.settings.bounds import shown
from edp.settings.tree import SettingsTree
from edp.storage import read_object, write_json

T = typing.TypeVar("T")
AGAIN = "remove it and give the command that wrote it again"


class ResultFile:
    """Base of the frozen dataclasses of result files.

    A field whose default is None, an empty tuple or an empty mapping is left out of the file while it has this default.
    Any other field is always written, None as null.

    Attributes:
        NAME: name of the file.
        SCHEMA: version of the form, the first key of the file; 0 for files without one.
        WHAT: noun for the content in messages.
        ADVICE: advice for a damaged file.
    """

    NAME: ClassVar[str]
    SCHEMA: ClassVar[int] = 0
    WHAT: ClassVar[str] = "results"
    ADVICE: ClassVar[str] = AGAIN

    @classmethod
    def read(cls, folder: str | Path) -> Self:
        """Read the file in a folder.

        Raises:
            StorageError: see `from_file`.
        """
        return cls.from_file(Path(folder) / cls.NAME)

    @classmethod
    def from_file(cls, path: str | Path) -> Self:
        """Read a file of this form.

        Raises:
            StorageError: the file cannot be read, is of another version, or a value in it has another form; the message
                names each such value.
        """
        return cls.from_table(read_object(path), f"'{path}'")

    @classmethod
    def from_table(cls, table: Mapping[str, object], where: str) -> Self:
        """Build the results from the content of a file, which messages call `where`.

        Raises:
            StorageError: the content is of another version, or a value in it has another form.
        """
        values = dict(table)
        schema = values.pop("schema", cls.SCHEMA) if cls.SCHEMA else 0
        if isinstance(schema, bool) or schema != cls.SCHEMA:
            raise StorageError(
                f"{where} is of another version of EDP: schema {shown(schema)}, expected {cls.SCHEMA}; {cls.ADVICE}"
            )
        return read_part(cls, values, where, cls.WHAT, cls.ADVICE)

    def to_table(self) -> dict[str, object]:
        """Return the content of the file."""
        return ({"schema": self.SCHEMA} if self.SCHEMA else {}) | plain_fields(self)

    def write(self, folder: str | Path) -> None:
        """Write the file into a folder."""
        write_json(Path(folder) / self.NAME, self.to_table())


def read_part(cls: type[T], table: object, where: str, what: str = "results", advice: str = AGAIN) -> T:
    """Build a dataclass of results from a part of a file, which messages call `where`.

    Raises:
        StorageError: a value has another form; the message names each such value.
    """
    try:
        return SettingsTree(what=what).build(cls, table, where)
    except ConfigError as error:
        raise StorageError(f"{error}\nThe file was changed by hand or is of another version: {advice}") from error


def plain_fields(value: Any) -> dict[str, object]:
    """Return the fields of a dataclass of results as JSON has them; see `ResultFile` for those that are left out."""
    empty = _empty_defaults(value.__class__)
    values = ((entry.name, getattr(value, entry.name)) for entry in fields(value))
    return {name: plain_value(entry) for name, entry in values if name not in empty or entry != empty[name]}


def plain_value(value: Any) -> Any:
    """Return a value of results as JSON has it."""
    if is_dataclass(value):
        return plain_fields(value)
    if isinstance(value, Mapping):
        return {name: plain_value(entry) for name, entry in value.items()}
    if isinstance(value, tuple | list):
        return [plain_value(entry) for entry in value]
    return str(value) if isinstance(value, Enum | Path) else value


def json_value(value: Any) -> Any:
    """Return a value as JSON has it: arrays become lists, and a number that is not finite becomes null.

    A field of a dataclass whose metadata say ``optional`` is left out while it is None.
    """
    if is_dataclass(value):
        parts = ((entry, getattr(value, entry.name)) for entry in fields(value))
        return {
            entry.name: json_value(part)
            for entry, part in parts
            if part is not None or not entry.metadata.get("optional")
        }
    if isinstance(value, Mapping):
        return {str(key): json_value(part) for key, part in value.items()}
    if hasattr(value, "tolist"):
        return json_value(value.tolist())
    if isinstance(value, list | tuple):
        return [json_value(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@cache
def _empty_defaults(cls: type) -> Mapping[str, object]:
    """Return the defaults that are empty, by name of the field."""
    defaults = {
        entry.name: entry.default_factory() if entry.default_factory is not MISSING else entry.default
        for entry in fields(typing.cast(Any, cls))
    }
    return {name: default for name, default in defaults.items() if default is None or default in ((), {})}
