"""Registry and interface of export targets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Protocol, get_type_hints

from edp.errors import ConfigError
from edp.registry import Registry
from edp.training.bundle import Bundle


class ExportTarget(Protocol):
    """A form in which a network leaves."""

    def write(self, bundle: Bundle, name: str, folder: Path) -> list[Path]:
        """Write a bundle under `folder`, which is made if it is not there; files of the same names are replaced.

        Args:
            bundle: the trained network.
            name: name of the network in the exported files.
            folder: output folder.

        Returns:
            The files, the one to read first in front.

        Raises:
            ExportError: the network or the name cannot be written in this form.
            StorageError: the folder cannot be written.
        """
        ...


TARGETS: Registry[type[ExportTarget]] = Registry("export target")


def make_target(name: str, options: Mapping[str, object] | None = None) -> ExportTarget:
    """Create a target by name with its options.

    Raises:
        ConfigError: there is no such target, it has no such option, or text that must be a number is none.
        ExportError: a value that the target does not take.
    """
    kind, stated_options = TARGETS[name], dict(options or {})
    option_types = _options(kind)
    # An option that the target lacks would be dropped silently; a spelling error must not change an export.
    for option in stated_options:
        if option not in option_types:
            has = f"it has {', '.join(option_types)}" if option_types else "it has none"
            raise ConfigError(f"export target '{name}' has no option '{option}' ({has}); leave it out")
    return kind(
        **{option: _read(name, option, value, option_types[option]) for option, value in stated_options.items()}
    )


def _options(kind: type[ExportTarget]) -> dict[str, type]:
    """Return the types of a target's options by name."""
    if not is_dataclass(kind):
        return {}
    hints = get_type_hints(kind)
    return {entry.name: hints[entry.name] for entry in fields(kind)}


def _read(target: str, option: str, value: object, kind: type) -> object:
    """Convert an option to the type of the target; text from the command line becomes a number or a boolean."""
    if not isinstance(value, str) or kind is str:
        return value
    try:
        return _SWITCH[value.lower()] if kind is bool else kind(value)
    except (KeyError, ValueError) as error:
        rule = "true or false" if kind is bool else "an integer" if kind is int else "a number"
        raise ConfigError(f"option '{option}' of export target '{target}' is '{value}'; it must be {rule}") from error


# Command lines give text only; these are the spellings of TOML, YAML and shells.
_SWITCH = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}
