"""Export targets: the registry, and what a target does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Protocol

from edp.errors import ConfigError
from edp.registry import Registry
from edp.training.bundle import Bundle


class ExportTarget(Protocol):
    """A form in which a network leaves."""

    def write(self, bundle: Bundle, name: str, folder: Path) -> list[Path]:
        """Write a bundle under `folder`, which is made if it is not there; files of the same names are replaced.

        Args:
            bundle: the trained network.
            name: what the network is called there.
            folder: where to.

        Returns:
            The files, the one to read first in front.

        Raises:
            ExportError: the network or the name cannot be written in this form.
            StorageError: the folder cannot be written.
        """
        ...


TARGETS: Registry[type[ExportTarget]] = Registry("export target")


def make_target(name: str, options: Mapping[str, object] | None = None) -> ExportTarget:
    """A target by name with its options.

    Raises:
        ConfigError: there is no such target, or it has no such option.
        ExportError: a value that the target does not take.
    """
    kind, given = TARGETS[name], dict(options or {})
    known: list[str] = [entry.name for entry in fields(kind)] if is_dataclass(kind) else []
    for option in given:
        if option not in known:
            has = f"it has {', '.join(known)}" if known else "it has none"
            raise ConfigError(f"export target '{name}' has no option '{option}' ({has}); leave it out")
    return kind(**given)
