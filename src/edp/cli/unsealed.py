"""The note on files of earlier versions, which have no hash of their content."""

from __future__ import annotations

from edp.cli.console import err
from edp.storage.seals import files_without_seal


def tell_of_unsealed_files() -> None:
    """Print one note that lists the files without a hash that this command has read."""
    files = files_without_seal()
    if files:
        more = f" and {len(files) - 1} more" if len(files) > 1 else ""
        err.print(
            f"note: {files[0]}{more}: written by an earlier version of EDP, without a hash, so nothing shows whether "
            "it was changed since; the command that wrote it adds the hash when it is given again"
        )
