"""Files of the tables of a report."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from edp.storage import make_folder, write_bytes
from edp.table import Table


def write_tables(folder: Path, tables: Iterable[Table]) -> None:
    """Write each table as ``<name>.csv`` and ``<name>.md``.

    Raises:
        StorageError: a file cannot be written.
    """
    for table in tables:
        stem = make_folder(folder) / table.name
        write_bytes(stem.with_suffix(".csv"), table.csv().encode("utf-8", "replace"))
        write_bytes(stem.with_suffix(".md"), table.markdown().encode("utf-8", "replace"))
