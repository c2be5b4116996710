"""Settings as typed trees: TOML tables to dataclasses and back, every problem reported at once with the closest key.

A field may hold a registered part: its table says with ``kind = "..."`` which one. A `SettingsTree` knows the
registries by the names of these fields; `build` and `plain_tree` are those of a tree without registered parts.
"""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

import pydantic

from edp import storage
from edp.errors import ConfigError, closest
from edp.registry import Registry
from edp.settings.bounds import shown
from edp.settings.earlier_keys import common_renames, note_earlier, present_keys
from edp.storage.reading import Table as Table

Change = str | Mapping[str, object]
"""A change of settings: ``key.path=value``, or a table."""
Parts = Mapping[str, Registry[type]]
"""Registries by the name of the field that holds one of their parts."""
T = typing.TypeVar("T")

SHOWN_CHANGE = 200
"""Of a ``--set``, in messages."""
_NUMBERS = frozenset((int, float, bool, type(None), Ellipsis))
_RULES = {
    "finite_number": "a finite number must hold",
    "float_type": "a number must hold",
    "int_from_float": "an integer must hold",
    "int_type": "an integer must hold",
    "string_type": "a text in quotes must hold",
    "tuple_type": "a list must hold, in brackets such as [1, 2]",
    "mapping_type": "a table must hold",
    "dict_type": "a table must hold",
}
"""By kind of pydantic's error, what must hold; kinds that are not listed are told in its words."""
MAX_LISTED, MAX_KEY = 50, 100
"""Problems that a message lists, and characters of a key that it repeats."""


def read_toml(path: str | Path) -> dict[str, object]:
    """Read a settings file.

    Raises:
        ConfigError: it cannot be read, is beyond the bounds of `edp.storage.read_toml`, or is not TOML.
    """
    return storage.read_toml(path, error=ConfigError)


def parse_toml(text: str, where: str) -> dict[str, object]:
    """Parse settings from a text; error messages call the text `where`.

    Raises:
        ConfigError: it is beyond the bounds of `edp.storage.parse_toml`, or is not TOML.
    """
    return storage.parse_toml(text, where, ConfigError)


def merged(base: Mapping[str, object], change: Mapping[str, object]) -> dict[str, object]:
    """Return `base` updated recursively with `change`. A table of another kind replaces the old table as a whole.

    A table that names no kind has options of whichever kind is named later.
    """
    result = dict(base)
    for key, value in change.items():
        old = result.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            same = "kind" not in old or value.get("kind", old["kind"]) == old["kind"]
            result[key] = merged(old, value) if same else value
        else:
            result[key] = value
    return result


def value_at(table: object, path: str, default: Any = None) -> Any:
    """Return the value at keys that are joined by points, or a default."""
    for key in path.split("."):
        if not isinstance(table, Mapping) or key not in table:
            return default
        table = table[key]
    return table


def with_value(table: object, path: str, value: object) -> dict[str, object]:
    """Return a table with another value at keys that are joined by points; missing tables on the way are added."""
    key, _, rest = path.partition(".")
    old = table if isinstance(table, Mapping) else {}
    return {**old, key: with_value(old.get(key), rest, value) if rest else value}


def override(change: Change) -> dict[str, object]:
    """Parse ``key.path=value`` into a table.

    A value that is not valid TOML becomes a string. A table is returned unchanged.

    Raises:
        ConfigError: not of this form.
    """
    if not isinstance(change, str):
        return dict(change)
    text = change
    key, sign, value = text.partition("=")
    if not sign or not key.strip():
        raise ConfigError(f"--set '{text}': write key.path=value, for example training.epochs=10")
    where = f"--set '{text[:SHOWN_CHANGE]}'"
    try:
        return parse_toml(f"{key.strip()} = {value.strip()}", where)
    except ConfigError:
        # Words need no quotes on a command line, where a shell would take them away.
        return parse_toml(f'{key.strip()} = "{value.strip()}"', where)


def combined(changes: Sequence[Mapping[str, object]]) -> dict[str, object]:
    """All changes as one, before they are laid over settings: a kind and its options may be given in any order.

    Laid one by one, a kind that came last would take the options with it that came before.
    """
    table: dict[str, object] = {}
    for change in changes:
        table = merged(table, change)
    return table


class SettingsTree:
    """Dataclasses from plain tables and plain tables from dataclasses.

    Args:
        parts: registries by the name of the field that holds one of their parts.
        usual_kinds: kind of a table without ``kind``, by field.
        what: the kind of file, as messages call it.
        positions: description of each entry of a list of fixed length, by its type.
        null_is_nan: whether null stands for a number that is not finite, for which JSON has no word.
    """

    def __init__(
        self,
        parts: Parts | None = None,
        usual_kinds: Mapping[str, str] | None = None,
        what: str = "settings",
        positions: Mapping[Any, tuple[str, ...]] | None = None,
        null_is_nan: bool = False,
    ) -> None:
        self.parts = dict(parts or {})
        self.usual_kinds = dict(usual_kinds or {})
        self.what = what
        self.positions = dict(positions or {})
        self.null_is_nan = null_is_nan

    def to_dict(self, value: Any, name: str = "") -> Any:
        """Nested plain values of a spec tree; registered parts carry their ``kind``; None is left out.

        Args:
            value: the spec, or a value of one.
            name: name of its field.
        """
        if name in self.parts and is_dataclass(value):
            return {"kind": self.parts[name].name_of(value)} | self._plain_fields(value)
        if name in self.parts and isinstance(value, tuple):
            return [self.to_dict(item, name) for item in value]
        if is_dataclass(value):
            return self._plain_fields(value)
        if isinstance(value, tuple | list):
            return [self.to_dict(item) for item in value]
        return str(value) if isinstance(value, Enum) else value

    def _plain_fields(self, spec: Any) -> dict[str, object]:
        values = {entry.name: getattr(spec, entry.name) for entry in fields(spec)}
        return {name: self.to_dict(value, name) for name, value in values.items() if value is not None}

    def build(self, cls: type[T], table: object, where: str, path: str = "") -> T:
        """Build a settings object from a table; missing keys take their defaults.

        Args:
            cls: dataclass of the tree's root.
            table: nested plain values by key.
            where: name of the file or of the changes in messages.
            path: key of the table in that file; empty for the whole file.

        Raises:
            ConfigError: every problem found, with its key path and the closest known key.
        """
        problems: list[str] = []
        spec = self._build(cls, table, path, problems)
        if problems:
            more = [f"and {len(problems) - MAX_LISTED:,} more"] if len(problems) > MAX_LISTED else []
            listed = "\n  - ".join(problems[:MAX_LISTED] + more)
            count = f"{len(problems)} problem" + ("s" if len(problems) > 1 else "")
            raise ConfigError(f"{self.what} {where}: {count}\n  - {listed}")
        return typing.cast(T, spec)

    def load(
        self,
        cls: type[T],
        path: str | Path | None,
        overrides: Sequence[str],
        of: str,
        options: Mapping[str, object] | None = None,
    ) -> T:
        """Load a settings object from a file, then apply command options, then overrides.

        Args:
            cls: dataclass of the tree's root.
            path: settings file; None takes the defaults.
            overrides: each ``key.path=value``, in any order.
            of: name of the settings in messages if there is no file.
            options: plain values by key.

        Raises:
            ConfigError: names every unknown key, wrong type and impossible value at once.
        """
        table = merged({} if path is None else self.renamed(cls, read_toml(path)), options or {})
        table = merged(table, self.renamed(cls, combined([override(text) for text in overrides])))
        where = of if path is None else f"'{path}'"
        return self.build(cls, table, where + (" with --set" if overrides else ""))

    def renamed(self, cls: type, table: Mapping[str, object], path: str = "") -> dict[str, object]:
        """Return a table that a user gave with the keys of this version, before it is merged with other tables.

        Tables need not be complete: where a part does not name its kind, all kinds count; the table of an unknown kind
        is unchanged. Earlier keys are recorded for a notice.

        Args:
            cls: dataclass of the table.
            table: plain values by key.
            path: key of the table in messages.

        Raises:
            ConfigError: a key is given by its earlier and by its present name.
        """
        return self._renamed([cls], table, path)

    def _renamed(self, classes: Sequence[type], table: Mapping[str, object], path: str) -> dict[str, object]:
        fields_by_class = [_settings_of(cls) for cls in classes]
        renames = common_renames(classes, {key for keys in fields_by_class for key in keys})
        result: dict[str, object] = {}
        for key, value in table.items():
            name = renames.get(key, key)
            where = _join(path, str(name))
            if name != key:
                if name in table:
                    raise ConfigError(f"'{_join(path, key)}' is now '{where}', and both are given; delete the first")
                note_earlier(_join(path, key), where)
            hints = [keys[name].hint for keys in fields_by_class if name in keys]
            result[name] = self._renamed_value(str(name), hints, value, where)
        return result

    def _renamed_value(self, name: str, hints: Sequence[Any], value: Any, path: str) -> Any:
        if isinstance(value, list):
            return [self._renamed_value(name, hints, entry, path) for entry in value]
        if not isinstance(value, Mapping) or not hints:
            return value
        if name in self.parts:
            kind = value.get("kind")
            registry = self.parts[name]
            # An unknown kind may be that of a plug-in that is not loaded yet, whose keys are not those of other kinds.
            is_registered = isinstance(kind, str) and kind in registry
            classes = [registry[str(kind)]] if is_registered else [] if "kind" in value else list(registry.values())
        else:
            forms = [_form(_strip_optional(hint)) for hint in hints]
            classes = [cls for form in forms for cls in (form.table, form.item) if cls is not None]
        return self._renamed(classes, value, path) if classes else value

    def _build(
        self, cls: type, table: Any, path: str, problems: list[str], beside: Mapping[str, type] | None = None
    ) -> Any:
        """Build one settings object.

        `beside` are the other parts that ``kind`` could select, named in error messages.
        """
        if not isinstance(table, Mapping):
            problems.append(f"{path}: expected a table, got {shown(table)}")
            return None
        settings_of_class = _settings_of(cls)
        before = len(problems)
        try:
            table = present_keys(cls, table, path)
        except ConfigError as error:
            problems.append(str(error))
            return None
        for key in table:
            if key not in settings_of_class:
                hint = _kinds_with(key, beside or {}) or closest(_key(key), list(settings_of_class))
                problems.append(f"unknown key '{_join(path, _key(key))}'{hint}")
        for name, entry in settings_of_class.items():
            if entry.required and name not in table:
                problems.append(f"'{_join(path, name)}' is missing; it must be given")
        values = {
            name: self._value(name, entry.hint, table[name], _join(path, name), problems)
            for name, entry in settings_of_class.items()
            if name in table
        }
        # Built only from sound values: the class's own checks would report what follows from these problems.
        if len(problems) > before:
            return None
        try:
            return cls(**values)
        except ConfigError as error:
            # Many specs begin their messages with the name of their table already.
            reason = str(error).removeprefix(f"{path.rpartition('.')[2]}: ")
            problems.append(f"{path}: {reason}" if path else reason)
            return None

    def _value(self, name: str, hint: Any, value: Any, path: str, problems: list[str]) -> Any:
        if value is None and _allows_none(hint):
            return None  # JSON has a word for it; TOML leaves the key out
        if value is None and self.null_is_nan and hint is float:
            return math.nan
        hint = _strip_optional(hint)
        form = _form(hint)
        if name in self.parts:
            if form.sequence:
                items = value if isinstance(value, list) else [value]
                return tuple(self._part(name, item, f"{path}[{i}]", problems) for i, item in enumerate(items))
            return self._part(name, value, path, problems)
        if form.table is not None and (form.table is hint or isinstance(value, Mapping)):
            return self._build(form.table, value, path, problems)
        if form.item is not None and isinstance(value, list):
            return tuple(self._build(form.item, item, f"{path}[{i}]", problems) for i, item in enumerate(value))
        if form.sequence and not form.endless and isinstance(value, list | tuple):
            return self._row(hint, value, path, problems)
        if form.values is not None and isinstance(value, Mapping):
            entries = {key: _join(path, _key(key)) for key in value}
            return {key: self._value("", form.values, value[key], where, problems) for key, where in entries.items()}
        return _scalar(hint, value, path, problems)

    def _row(self, hint: Any, values: list[Any] | tuple[Any, ...], path: str, problems: list[str]) -> Any:
        """Check and convert a list of fixed length, entry by entry, so that messages name the wrong entry."""
        hints = typing.get_args(hint)
        labels = self.positions.get(hint, tuple(map(str, range(len(hints)))))
        if len(values) != len(hints):
            named = f" ({', '.join(labels)})" if hint in self.positions else ""
            problems.append(f"{path} = {shown(values)} lists {len(values):,}; a list of {len(hints)} must hold{named}")
            return None
        entries = zip(hints, values, labels, strict=True)
        return tuple(self._value("", entry, value, f"{path}[{label}]", problems) for entry, value, label in entries)

    def _part(self, name: str, table: Any, path: str, problems: list[str]) -> Any:
        registry = self.parts[name]
        if isinstance(table, str):
            table = {"kind": table}
        if isinstance(table, Mapping) and name in self.usual_kinds:
            table = {"kind": self.usual_kinds[name], **table}
        if not isinstance(table, Mapping) or "kind" not in table:
            problems.append(f'{path}: say which {registry.what} with kind = "..."{closest("", registry)}')
            return None
        if not isinstance(table["kind"], str):
            problems.append(f"{path}.kind = {shown(table['kind'])}: the name of one must hold{closest('', registry)}")
            return None
        try:
            cls = registry[_key(table["kind"])]
        except ConfigError as error:
            problems.append(f"{path}.kind: {error}")
            return None
        return self._build(cls, {key: value for key, value in table.items() if key != "kind"}, path, problems, registry)


def _kinds_with(key: Any, parts: Mapping[str, type]) -> str:
    """Return a hint for the message on an unknown key: the kinds that have the key; empty if no kind has it."""
    kinds = [f"'{name}'" for name, part in parts.items() if key in _settings_of(part)]
    return f"; it belongs to kind = {' or '.join(kinds)}" if kinds else ""


class _Setting(typing.NamedTuple):
    """A field of a spec: its type, and whether it has no default."""

    hint: Any
    required: bool


# A search builds thousands of experiments, and reading their types each time took nine tenths of the time.
@cache
def _settings_of(cls: type) -> Mapping[str, _Setting]:
    hints = typing.get_type_hints(cls)
    return {
        entry.name: _Setting(hints[entry.name], entry.default is MISSING and entry.default_factory is MISSING)
        for entry in fields(cls)
    }


class _Form(typing.NamedTuple):
    """Structure of a type hint: sequence, nested table or plain value.

    Attributes:
        sequence: it is a tuple; `endless`: of any length.
        table: the spec that it is, or the first one that it may be.
        item: the spec of each entry of a tuple.
        values: the type of a mapping's values.
    """

    sequence: bool
    endless: bool
    table: type | None
    item: type | None
    values: Any


@cache
def _form(hint: Any) -> _Form:
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    sequence = origin is tuple
    alternatives = () if sequence or origin is Mapping else inner
    table: Any = hint if is_dataclass(hint) else next((c for c in alternatives if is_dataclass(c)), None)
    item: Any = inner[0] if sequence and inner and is_dataclass(inner[0]) else None
    values = inner[1] if origin is Mapping and inner else None
    return _Form(sequence, Ellipsis in inner, table, item, values)


@cache
def _allows_none(hint: Any) -> bool:
    is_union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    return hint is type(None) or (is_union and type(None) in typing.get_args(hint))


@cache
def _strip_optional(hint: Any) -> Any:
    """Return the list or mapping type of a hint that also allows None; other hints unchanged."""
    inner = [one for one in typing.get_args(hint) if one is not type(None)]
    is_list = len(inner) == 1 and typing.get_origin(inner[0]) in (tuple, Mapping)
    return inner[0] if is_list and _allows_none(hint) else hint


@cache
def _adapter(hint: Any) -> pydantic.TypeAdapter[Any]:
    # TOML has nan and inf; no setting means them.
    return pydantic.TypeAdapter(hint, config=pydantic.ConfigDict(allow_inf_nan=False))


@cache
def _leaves(hint: Any) -> frozenset[Any]:
    inner = typing.get_args(hint)
    return frozenset().union(*map(_leaves, inner)) if inner else frozenset((hint,))


def _scalar(hint: Any, value: Any, path: str, problems: list[str]) -> Any:
    """Check and convert a value or a nested list with pydantic; refuse silent coercions first."""
    leaves = _leaves(hint)
    # pydantic takes true for 1 and "3" for 3: a typing error would become a setting.
    if _truth_in(value) and not leaves & {bool, Any, object}:
        problems.append(f"{path} = {shown(value)}: true and false are no numbers or names; write one")
        return None
    if leaves <= {bool, type(None)} and not isinstance(value, bool):
        problems.append(f"{path} = {shown(value)}: write true or false")
        return None
    if leaves <= _NUMBERS and _text_in(value):
        problems.append(f"{path} = {shown(value)}: a text is no number; write it without quotes")
        return None
    try:
        return _adapter(hint).validate_python(value)
    except pydantic.ValidationError as error:
        # One problem a key: pydantic lists one for each type that a union has.
        first = error.errors()[0]
        rule = _RULES.get(first["type"], f"{first['msg'][0].lower()}{first['msg'][1:]}")
        problems.append(f"{path} = {shown(value)}: {rule}")
        return None


def _text_in(value: Any) -> bool:
    """Whether a value is a text, or a list that holds one."""
    return any(map(_text_in, value)) if isinstance(value, list | tuple) else isinstance(value, str)


def _truth_in(value: Any) -> bool:
    """Return whether a value is or contains a boolean, which Python also accepts as a number."""
    if isinstance(value, Mapping):
        return any(map(_truth_in, value.values()))
    return any(map(_truth_in, value)) if isinstance(value, list | tuple) else isinstance(value, bool)


def _key(name: str) -> str:
    """Return a key or name, shortened for messages."""
    return name if len(name) <= MAX_KEY else f"{name[:MAX_KEY]}..."


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


_PLAIN = SettingsTree()
build = _PLAIN.build
plain_tree = _PLAIN.to_dict
