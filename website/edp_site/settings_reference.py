"""Reference of settings: key, type, default, range and meaning of each, from the dataclasses and their docstrings."""

from __future__ import annotations

import contextlib
import inspect
import re
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from typing import Any, NamedTuple

from edp.config.control import ControlExperiment
from edp.config.experiment import Experiment
from edp.config.monitor import MonitorExperiment
from edp.config.twin import TwinExperiment
from edp.errors import ConfigError
from edp.logs.source import RecordingEntry
from edp.settings.bounds import bounds_of
from edp.settings.earlier_keys import KEYS
from edp.sim.scenario_file import ScenarioFile
from edp_site.settings_keys import TABLES, TREES

ROOTS: Mapping[str, tuple[str, type]] = {
    "Training (`edp train`)": ("", Experiment),
    **{f"Table `[{name}]`": (name, cls) for name, cls in TABLES.items()},
    "Twins (`edp twin`)": ("", TwinExperiment),
    "Simulation (`edp simulate`, scenario files)": ("", ScenarioFile),
    "Closed loops (`edp loop`)": ("", ControlExperiment),
    "Monitors (`edp monitor fit`)": ("", MonitorExperiment),
    "Data-set files": ("recordings", RecordingEntry),
}
"""Sections of the page: the table in which the keys stand, and the class that reads them."""
BASIC = frozenset(
    (
        *("task.features", "task.targets", "task.horizons", "task.mode", "split.kind", "auto.time_budget_min"),
        *("model.backbone.kind", "model.window", "training.epochs", "training.seed", "training.chunks.length"),
        *("training.optimizer.learning_rate", "training.patience", "evaluation.baselines", "machine", "recordings"),
        *("minutes", "seed", "twin.kind", "evaluation.duration_s", "hours_per_false_alarm", "task.kind"),
        *("controller.kind", "loops", "rate_hz", "finetune.epochs", "distil.units", "compress.budget"),
        *("screen.targets", "screen.horizon", "search.mode", "search.backbones"),
    )
)
"""Keys that most users set; all others are advanced."""
_NAMES = {int: "integer", float: "number", str: "text", bool: "true or false", type(None): "", Any: "value"}


class Key(NamedTuple):
    """A settings key: path, type, default, range and meaning, as the page shows them."""

    path: str
    form: str
    default: str
    bounds: str
    meaning: str


class Section(NamedTuple):
    """A table of settings, or a registered part of one: title, summary and keys."""

    title: str
    summary: str
    keys: tuple[Key, ...]


def sections_of(table: str, cls: type) -> list[Section]:
    """Return the sections of a settings class: its own keys, then the keys of each table and part below.

    Args:
        table: table in which its keys stand; empty for the root of a file.
        cls: the class.
    """
    return list(_sections(table, f"`[{table}]`" if table else "Top level", cls, set()))


def _sections(path: str, title: str, cls: type, seen: set[tuple[str, type]]) -> Iterator[Section]:
    if (path, cls) in seen:
        return
    seen.add((path, cls))
    if all(entry.default is not MISSING or entry.default_factory is not MISSING for entry in fields(cls)):
        # Bounds are recorded when an object is made, also where its defaults alone are refused.
        with contextlib.suppress(ConfigError):
            cls()
    hints, meanings, bounds = typing.get_type_hints(cls), meanings_of(cls), bounds_of(cls)
    keys = []
    for entry in fields(cls):
        where = f"{path}.{entry.name}" if path else entry.name
        limit = bounds.get(entry.name)
        form = _form(entry.name, hints[entry.name])
        rule = "" if limit is None else limit.rule("x").removeprefix("integers, ")
        keys.append(Key(where, form, _default(entry), rule, meanings.get(entry.name, "")))
    yield Section(title, _summary(cls), tuple(keys))
    for entry in fields(cls):
        where = f"{path}.{entry.name}" if path else entry.name
        for tree in TREES:
            registry = tree.parts.get(entry.name)
            if registry is not None and _matches(hints[entry.name], registry):
                for kind, part in registry.items():
                    yield from _sections(where, f'`{where}`: `kind = "{kind}"`', part, seen)
                break
        else:
            for inner in _dataclasses(hints[entry.name]):
                yield from _sections(where, f"`[{where}]`", inner, seen)


def _matches(hint: Any, registry: Mapping[str, Any]) -> bool:
    """Return whether the parts of a registry stand in a field of this type."""
    plain = {str, int, float, bool}
    leaves = set(_leaves(hint))
    settled = [leaf for leaf in leaves if isinstance(leaf, type) and is_dataclass(leaf)]
    # A field of the same name may stand in another tree, such as the task of a closed loop.
    if settled and not any(issubclass(part, leaf) for part in registry.values() for leaf in settled):
        return False
    return bool(leaves - plain - {type(None), Ellipsis}) and all(isinstance(part, type) for part in registry.values())


def _leaves(hint: Any) -> Iterator[Any]:
    inner = typing.get_args(hint)
    if inner:
        for one in inner:
            yield from _leaves(one)
    else:
        yield hint


def _dataclasses(hint: Any) -> Iterator[type]:
    for leaf in _leaves(hint):
        if isinstance(leaf, type) and is_dataclass(leaf):
            yield leaf


def meanings_of(cls: type) -> dict[str, str]:
    """Return the meaning of each field, from the section ``Attributes`` of the docstrings of a class and its bases."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        text = inspect.cleandoc(base.__dict__.get("__doc__") or "")
        _, _, listed = text.partition("Attributes:\n")
        for name, meaning in re.findall(r"^    (\w+): ((?:.+)(?:\n {8,}.+)*)", listed, re.MULTILINE):
            found[name] = " ".join(meaning.split())
    return found


def _summary(cls: type) -> str:
    text = inspect.cleandoc(cls.__doc__ or "").split("\n\n")[0]
    return "" if text.startswith(f"{cls.__name__}(") else " ".join(text.split())


def _form(name: str, hint: Any) -> str:
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(filter(None, dict.fromkeys(_form(name, one) for one in inner)))
    if origin is tuple:
        return "list of " + " and ".join(dict.fromkeys(_form(name, one) for one in inner if one is not Ellipsis))
    if isinstance(hint, type) and issubclass(hint, Enum):
        return " or ".join(f'"{member.value}"' for member in hint)
    if origin is typing.Literal:
        return " or ".join(f'"{value}"' for value in inner)
    return _NAMES.get(hint, "table")


def _default(entry: Field[Any]) -> str:
    if entry.default is MISSING and entry.default_factory is MISSING:
        return "required"
    value = entry.default if entry.default is not MISSING else entry.default_factory()  # type: ignore[misc]
    return "" if value is None or is_dataclass(value) else f"`{_shown(value)}`"


def _shown(value: Any) -> str:
    if isinstance(value, Enum | str):
        return f'"{value}"'
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "{...}" if value else "{}"
    if isinstance(value, tuple | list):
        if any(is_dataclass(entry) for entry in value):
            return f"[{len(value)} tables]"
        return f"[{', '.join(map(_shown, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def settings_page() -> str:
    """Return the reference of all settings."""
    lines = [
        "# Settings reference",
        "",
        "Put a key into a settings file (TOML), or after `--set`, such as `--set training.epochs=10`. Keys "
        "marked *basic* are those that most users set. [Settings](../settings.md) explains files and presets.",
    ]
    for title, (table, cls) in ROOTS.items():
        lines += ["", f"## {title}"]
        for section in sections_of(table, cls):
            lines += ["", f"### {section.title}", "", *([_cell(section.summary), ""] if section.summary else [])]
            if section.keys:
                lines += ["| Key | Level | Type | Default | Range | Meaning |", "|---|---|---|---|---|---|"]
            lines += [_row(key) for key in section.keys]
    lines += [
        "",
        "## Earlier names",
        "",
        "Earlier versions used other names for these keys. They are read for one release.",
    ]
    lines += ["", "| Earlier | Now |", "|---|---|"]
    renames = sorted({(old, new) for names in KEYS.values() for old, new in names.items()})
    lines += [f"| `{old}` | `{new}` |" for old, new in renames]
    return "\n".join(lines) + "\n"


def _row(key: Key) -> str:
    level = "*basic*" if key.path in BASIC else "advanced"
    name = key.path.rpartition(".")[2]
    return f"| `{name}` | {level} | {key.form} | {key.default} | {key.bounds} | {_cell(key.meaning)} |"


def _cell(text: str) -> str:
    return text.replace("``", "`").replace("|", "\\|").replace("<", "&lt;")
