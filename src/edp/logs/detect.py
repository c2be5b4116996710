"""Which format a file holds, by its content, checked against its ending."""

from __future__ import annotations

from pathlib import Path

from edp.errors import DataError, closest
from edp.logs.raw import FORMATS, LogFormat, RawLog
from edp.signals import SignalMap

_HEAD = 4096
_EXPORT = {
    ".mldatx": "open it in the Simulation Data Inspector and export MAT, CSV or Parquet",
    ".dat": "save it as MDF 4 (.mf4), MAT or CSV with your measurement tool",
    ".mcap": "convert the wanted topics to CSV or Parquet",
    ".bag": "convert the wanted topics to CSV or Parquet",
    ".db3": "convert the wanted topics to CSV or Parquet",
    ".txt": "rename it to .csv if it holds a table",
    ".xlsx": "save the sheet as CSV",
    ".xls": "save the sheet as CSV",
}
_OTHERS = {
    b"PK\x03\x04": "a ZIP archive (xlsx, mldatx and the like)",
    b"\x1f\x8b": "gzip-compressed data",
    b"\x89HDF\r\n\x1a\n": "HDF5 that is not a MAT v7.3 file",
    b"SQLite format 3": "an SQLite database",
}


def known_suffixes() -> tuple[str, ...]:
    """All file endings that can be read, in the order of the registry."""
    return tuple(suffix for part in FORMATS.values() for suffix in part.suffixes)


def format_for(path: Path) -> LogFormat:
    """The format that a file's ending stands for.

    Raises:
        DataError: no format has this ending; says which are known and how to export the common others.
    """
    suffix = path.suffix.lower()
    for part in FORMATS.values():
        if suffix in part.suffixes:
            return part
    advice = f"; {_EXPORT[suffix]}" if suffix in _EXPORT else closest(suffix, known_suffixes())
    raise DataError(f"'{path}': files ending in '{suffix}' cannot be read or written{advice}")


def open_log(path: str | Path, signal_map: SignalMap) -> RawLog:
    """Read a log file as it is, before any map of units and time.

    Raises:
        DataError: missing, empty, unreadable or damaged file, or one that is not what its ending says.
    """
    source = Path(path)
    named = format_for(source)
    try:
        with source.open("rb") as stream:
            head = stream.read(_HEAD)
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"cannot read '{source}': {reason}; check the path and its permissions") from error
    if not head:
        raise DataError(f"'{source}' is empty (0 bytes); copy or export it again")
    if not named.claims(head):
        raise DataError(f"'{source}' is named {source.suffix} but holds {_content(head)}; rename it or export it again")
    return named.read(source, signal_map)


def _content(head: bytes) -> str:
    for magic, text in _OTHERS.items():
        if head.startswith(magic):
            return text
    for part in FORMATS.values():
        if part.claims(head):
            return part.content
    return "binary data of an unknown kind"
