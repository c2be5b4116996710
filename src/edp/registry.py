"""Named parts, and the plug-ins that add parts from packages of users (docs/reference/parts.md)."""

from __future__ import annotations

import importlib
import os
import sys
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from typing import Any, Generic, TypeVar

from edp.errors import ConfigError, brief, closest

T = TypeVar("T")

GROUP, VARIABLE = "edp.plugins", "EDP_PLUGINS"
"""Group of entry points, and environment variable, that name the modules of plug-ins."""
_OWN = "edp"
_NAMING_KEYS = ("kind", "how")
"""Keys of plain settings whose value is the name of a registered part."""
_SHOWN = 80
"""Characters of a text from a file in a message."""
_MAX_ORIGINS = 100


@dataclass(frozen=True)
class Origin:
    """Origin of a plug-in part: module, package and version.

    Attributes:
        what: what the registry holds, for example ``block``.
        part: name of the part.
        module: module that registered it.
        package: distribution of the module; empty where none is known.
        version: version of the distribution.
    """

    what: str
    part: str
    module: str
    package: str = ""
    version: str = ""

    def advice(self) -> str:
        """Return what to do where the part is not registered."""
        from_package = f"package '{_quote(self.package)}' {_quote(self.version)} " if self.package else ""
        came = f"it came from {from_package}(module {_quote(self.module)})"
        if self.module == "__main__":
            return f"{came}; a script registered it: put it into a module and set {VARIABLE} to that module"
        install = f"pip install {_quote(self.package)}, or " if self.package else ""
        return f"{came}; {install}set {VARIABLE}={_quote(self.module)}"


class Registry(Mapping[str, T], Generic[T]):
    """Parts of one kind by name, in the order of registration.

    Help texts, search spaces, report rows and contract tests read registries, so a new part is one file and
    one ``@REGISTRY.register("name")``. A name that is missing is looked for in plug-ins.
    """

    def __init__(self, what: str) -> None:
        self.what = what
        self._parts: dict[str, T] = {}
        self._modules: dict[str, str] = {}
        _PLUGINS.registries.add(self)

    __hash__ = object.__hash__

    def register(self, name: str) -> Callable[[T], T]:
        """Return a decorator that registers its argument under `name`. Raises `ConfigError` if the name exists."""
        module = str(sys._getframe(1).f_globals.get("__name__", ""))

        def enter(part: T) -> T:
            if name in self._parts:
                first = self._modules.get(name)
                by = "EDP" if first is None else f"module {first}"
                raise ConfigError(f"{self.what} '{name}' is registered twice, first by {by}; choose another name")
            self._parts[name] = part
            if module.partition(".")[0] != _OWN:
                self._modules[name] = module
            return part

        return enter

    def __getitem__(self, name: str) -> T:
        if name not in self._parts:
            load_plugins()
        try:
            return self._parts[name]
        except KeyError:
            near = closest(name, self._parts)
            hint = _PLUGINS.hint(self.what, name, typo="did you mean" in near)
            raise ConfigError(f"unknown {self.what} '{name}'{near}{hint}") from None

    def __contains__(self, name: object) -> bool:
        return name in self._parts

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts)

    def __len__(self) -> int:
        return len(self._parts)

    def name_of(self, part: object) -> str:
        """Return the name under which `part` (or the class of `part`) is registered."""
        for name, registered in self._parts.items():
            if registered is part or registered is type(part):
                return name
        raise ConfigError(f"{part!r} is not a registered {self.what}")

    def module_of(self, name: str) -> str | None:
        """Return the module outside EDP that registered a part; None for a part of EDP."""
        return self._modules.get(name)

    def forget(self, module_parts: Mapping[str, str]) -> None:
        """Remove parts whose module could not be loaded to its end."""
        for name in module_parts:
            self._parts.pop(name, None)
            self._modules.pop(name, None)

    def list_added_since(self, names: Mapping[str, str]) -> dict[str, str]:
        """Return the parts of plug-ins that are not among `names`, with their modules."""
        return {name: module for name, module in self._modules.items() if name not in names}

    @property
    def plugin_parts(self) -> Mapping[str, str]:
        """Parts of plug-ins with their modules."""
        return dict(self._modules)


class _Plugins:
    """Plug-ins that this process has loaded."""

    def __init__(self) -> None:
        self.registries: weakref.WeakSet[Registry[Any]] = weakref.WeakSet()
        self.loaded = False
        self.failures: list[str] = []
        self.packages: dict[str, tuple[str, str]] = {}
        self.recorded: dict[tuple[str, str], Origin] = {}

    def load(self) -> list[str]:
        """Import the modules of plug-ins, once; return what failed now."""
        if self.loaded:
            return []
        # Set first: a plug-in that imports EDP comes here again.
        self.loaded = True
        for entry in sorted(metadata.entry_points(group=GROUP), key=lambda one: one.name):
            where = f"plug-in '{entry.name}'"
            if entry.dist is not None:
                self.packages[entry.module.partition(".")[0]] = (entry.dist.name, entry.dist.version)
                where += f" of package '{entry.dist.name}' {entry.dist.version}"
            self._take(where, entry.load)
        for name in filter(None, (word.strip() for word in os.environ.get(VARIABLE, "").split(","))):
            self._take(f"plug-in '{name}' of {VARIABLE}", partial(importlib.import_module, name))
        return list(self.failures)

    def _take(self, where: str, load: Callable[[], object]) -> None:
        before = {registry: registry.plugin_parts for registry in self.registries}
        try:
            entry = load()
            if callable(entry):
                entry()
        except (Exception, SystemExit) as error:
            # What it had registered goes: half a plug-in would fail later, with another message.
            for registry in self.registries:
                registry.forget(registry.list_added_since(before.get(registry, {})))
            kind = "" if isinstance(error, ConfigError) else f"{type(error).__name__}: "
            self.failures.append(f"{where} cannot be loaded and is left out: {kind}{brief(error)}")

    def origin(self, registry: Registry[Any], part: str) -> Origin | None:
        """Return the origin of a part; None for a part of EDP."""
        module = registry.module_of(part)
        if module is None:
            return None
        top = module.partition(".")[0]
        if top not in self.packages:
            names = metadata.packages_distributions().get(top, [])
            self.packages[top] = (names[0], metadata.version(names[0])) if names else ("", "")
        return Origin(registry.what, part, module, *self.packages[top])

    def hint(self, what: str, part: str, typo: bool) -> str:
        """Return the plug-in advice for an unknown part; an empty text if a known name is close."""
        origin = self.recorded.get((what, part))
        if origin is not None:
            return f"; {origin.advice()}"
        if self.failures:
            return f"; {self.failures[0]}"
        return "" if typo else f"; a part of your own package needs {VARIABLE}=MODULE or an entry point '{GROUP}'"


_PLUGINS = _Plugins()


def load_plugins() -> list[str]:
    """Import the modules that entry points and ``EDP_PLUGINS`` name, once per process.

    Returns:
        a sentence for each plug-in that could not be loaded by this call; its parts are left out.
    """
    return _PLUGINS.load()


def origins_in(plain: Any) -> list[dict[str, str]]:
    """Return the parts of plug-ins that plain settings name, as entries for a file."""
    named = set(_kinds(plain))
    origins = [
        _PLUGINS.origin(registry, part)
        for registry in sorted(_PLUGINS.registries, key=lambda one: one.what)
        for part in registry.plugin_parts
        if part in named
    ]
    return [
        {"what": o.what, "part": o.part, "module": o.module, "package": o.package, "version": o.version}
        for o in origins
        if o is not None
    ]


def _kinds(plain: Any) -> Iterator[str]:
    """Names of parts in nested plain values."""
    if isinstance(plain, Mapping):
        for key, value in plain.items():
            if key in _NAMING_KEYS and isinstance(value, str):
                yield value
            else:
                yield from _kinds(value)
    elif isinstance(plain, list | tuple):
        for value in plain:
            yield from _kinds(value)


def missing_parts(entries: Any, plain: Any) -> list[str]:
    """Return a sentence for each recorded part that `plain` names and that is not registered here.

    Nothing that a file names is imported: its texts only appear in messages, cut and escaped.

    Args:
        entries: what `origins_in` gave, from a file; entries of another form are left out.
        plain: the settings that must be built.
    """
    origins = [o for entry in _limit_entries(entries) if (o := _origin_of(entry)) is not None]
    if origins:
        load_plugins()
    named, sentences = set(_kinds(plain)), []
    for origin in origins:
        _PLUGINS.recorded[origin.what, origin.part] = origin
        alike = [registry for registry in _PLUGINS.registries if registry.what == origin.what]
        if origin.part in named and not any(origin.part in registry for registry in alike):
            sentences.append(f"{_quote(origin.what)} '{_quote(origin.part)}': not registered; {origin.advice()}")
    return sentences


def _limit_entries(entries: Any) -> Sequence[Any]:
    return entries[:_MAX_ORIGINS] if isinstance(entries, list) else ()


def _origin_of(entry: Any) -> Origin | None:
    keys = ("what", "part", "module", "package", "version")
    if not isinstance(entry, Mapping) or not all(isinstance(entry.get(key), str) for key in keys):
        return None
    return Origin(**{key: entry[key] for key in keys})


def _quote(text: str) -> str:
    """Return a text from a file as a message may have it."""
    return "".join(c if c.isprintable() else "?" for c in text[:_SHOWN])
