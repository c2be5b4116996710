"""Named parts: a mapping that refuses duplicates and offers the closest name for a miss."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Generic, TypeVar

from edp.errors import ConfigError, closest

T = TypeVar("T")


class Registry(Mapping[str, T], Generic[T]):
    """Parts of one kind by name, in the order of registration.

    Help texts, search spaces, report rows and contract tests read registries, so a new part is one file and
    one ``@REGISTRY.register("name")``.
    """

    def __init__(self, what: str) -> None:
        self.what = what
        self._parts: dict[str, T] = {}

    def register(self, name: str) -> Callable[[T], T]:
        """Decorator that enters its argument under `name`; raises `ConfigError` on a duplicate."""

        def enter(part: T) -> T:
            if name in self._parts:
                raise ConfigError(f"{self.what} '{name}' is registered twice; choose another name")
            self._parts[name] = part
            return part

        return enter

    def __getitem__(self, name: str) -> T:
        try:
            return self._parts[name]
        except KeyError:
            raise ConfigError(f"unknown {self.what} '{name}'{closest(name, self._parts)}") from None

    def __contains__(self, name: object) -> bool:
        return name in self._parts

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts)

    def __len__(self) -> int:
        return len(self._parts)

    def name_of(self, part: object) -> str:
        """The name under which `part` (or the class of `part`) is registered."""
        for name, registered in self._parts.items():
            if registered is part or registered is type(part):
                return name
        raise ConfigError(f"{part!r} is not a registered {self.what}")
