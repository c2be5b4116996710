"""Export targets: the registry, and what a target does."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

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
