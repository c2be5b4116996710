"""Asks before code of somebody else runs on this computer."""

from __future__ import annotations

import sys
from pathlib import Path

import typer

from edp.cli.console import err
from edp.errors import ConfigError
from edp.storage.paths import is_there

FMU_CODE = "An FMU holds native code, which edp loads and runs on this computer with your rights"


def ask(why: str) -> None:
    """Ask on a terminal whether to continue.

    Raises:
        ConfigError: there is no terminal, or the answer is no.
    """
    # Without a person at the terminal nobody can agree.
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise ConfigError(f"{why}. Give --yes if you trust its source; nothing was run")
    err.print(f"{why}.")
    if not typer.confirm("Go on?", err=True):
        raise ConfigError("nothing was run")


def ask_for_fmus(yes: bool, *plants: Path | None) -> None:
    """Ask for permission to run the FMUs among the plants, unless they are declared trusted.

    Raises:
        ConfigError: there is no terminal, or the answer is no.
    """
    from edp.workflows.control import is_fmu

    for plant in plants:
        # Whether one that is not there may run is no question; what reads it says that it is missing.
        if plant is not None and is_fmu(plant) and is_there(plant) and not yes:
            ask(f"'{plant}': {FMU_CODE}")
