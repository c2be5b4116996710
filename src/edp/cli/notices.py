"""Notes of every command: slow logs, missing sandbox layers, and files without a hash."""

from __future__ import annotations

import sys
from pathlib import Path

from edp.cli.console import err
from edp.sandbox import layers, sandbox
from edp.settings.earlier_keys import used_earlier_keys
from edp.storage.memory import readable
from edp.storage.seals import files_without_seal
from edp.wording import number

# Each line takes twice as long: a slow log is told often at first, and never floods a terminal.
_AGAIN = 2.0
"""Times as long until the next line: after 5, 10, 20, 40 s and so on."""


class SlowLogs:
    """Says on standard error which log is being read, how long it has taken, and how large it is."""

    def __init__(self) -> None:
        self.path: Path | None = None
        self.next_s = 0.0

    def __call__(self, path: Path, seconds: float, size: int) -> None:
        """Say so, ever more seldom for one log."""
        # A new log, or the same one from the start.
        if path != self.path or seconds < self.next_s / _AGAIN:
            self.path, self.next_s = path, 0.0
        if seconds >= self.next_s:
            err.print(f"reading '{path.name}' ({number(seconds, 0)} s, {readable(size)})")
            self.next_s = _AGAIN * seconds


def tell_of_slow_logs() -> None:
    """Say what takes long, on a terminal, and wherever no program reads the output."""
    if err.is_terminal or "--json" not in sys.argv:
        sandbox.watch(SlowLogs())


def tell_of_missing_layers() -> None:
    """Say on standard error, once in each command, that logs are read with less protection than elsewhere."""
    layers.announce_by(lambda text: err.print(f"warning: {text}"))


def tell_of_earlier_keys() -> None:
    """Print one note that lists the keys of settings that have another name now."""
    if renamed := used_earlier_keys():
        listed = ", ".join(f"{key} (now {present})" for key, present in renamed.items())
        err.print(f"note: settings with earlier names, which the next release will no longer read: {listed}")


def tell_of_unsealed_files() -> None:
    """Print one note that lists the files without a hash that this command has read."""
    files = files_without_seal()
    if files:
        more = f" and {len(files) - 1} more" if len(files) > 1 else ""
        err.print(
            f"note: {files[0]}{more}: written by an earlier version of EDP, without a hash, so nothing shows whether "
            "it was changed since; the command that wrote it adds the hash when it is given again"
        )
