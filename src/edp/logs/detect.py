"""Detection of file formats by content, checked against the file ending."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from edp.errors import DataError, closest
from edp.logs.formats.base import FORMATS, LogFormat, RawLog
from edp.logs.sandboxed import read_apart
from edp.signals import SignalMap
from edp.storage.paths import entries_of, is_file_at, is_folder_at, status_of

_HEAD = 4096
"""Number of bytes read to detect a format, longer than the header of every format."""
BAG_MARK = "metadata.yaml"
"""File that identifies a folder as a ROS 2 bag."""
_ARRAYS = (
    "write its arrays as CSV or Parquet, a column a channel (in Python: pandas.DataFrame(...).to_parquet), or give "
    "them to edp.Recordings.from_arrays"
)
_DECODE = (
    "it holds frames of a bus: decode them with their DBC file into signals, as MDF 4 or CSV (in Python: asammdf or "
    "cantools)"
)
_EXPORT = {
    ".mldatx": (
        "only MATLAB reads MLDATX: open it in the Simulation Data Inspector, press Export and choose a MAT, Parquet or "
        "CSV file, or in MATLAB: Simulink.sdi.load('run.mldatx'); "
        "Simulink.sdi.exportRun(Simulink.sdi.getAllRunIDs, to='file', filename='run.mat')"
    ),
    ".part": "the download is not finished; wait for it or load it again",
    ".crdownload": "the download is not finished; wait for it or load it again",
    ".download": "the download is not finished; wait for it or load it again",
    ".partial": "the download is not finished; wait for it or load it again",
    ".zip": "unpack it and give the files in it",
    ".mf4z": "unpack it (it is a ZIP archive) and give the file in it",
    ".gz": "unpack it and give the file in it",
    ".7z": "unpack it and give the files in it",
    ".active": "the bag was not closed (its recorder was killed): run 'rosbag reindex' and rename it to .bag",
    ".dat": "save it as MDF 4 (.mf4), MAT or CSV with your measurement tool",
    ".blf": _DECODE,
    ".asc": _DECODE,
    ".trc": _DECODE,
    ".xlsx": "save the sheet as CSV",
    ".xls": "save the sheet as CSV",
    ".ods": "save the sheet as CSV",
    ".npz": _ARRAYS,
    ".npy": _ARRAYS,
    ".pkl": _ARRAYS,
    ".pickle": _ARRAYS,
    ".feather": _ARRAYS,
    ".h5": "copy its tables to CSV or Parquet (in Python: pandas or h5py), or save it with MATLAB's -v7.3 as .mat",
    ".hdf5": "copy its tables to CSV or Parquet (in Python: pandas or h5py), or save it with MATLAB's -v7.3 as .mat",
    ".json": "write its numbers as CSV or Parquet, a row a sample (in Python: pandas.DataFrame(...).to_csv)",
    ".svdx": "export it in TwinCAT Scope as CSV with a tab or a semicolon",
    ".tdms": "export it as MDF 4 (.mf4), MAT or CSV with your measurement tool",
}
_OTHERS = {
    b"PK\x03\x04": "a ZIP archive (xlsx, mldatx and the like)",
    b"\x1f\x8b": "gzip-compressed data",
    b"\x89HDF\r\n\x1a\n": "HDF5 that is not a MAT v7.3 file",
    b"PARE": "an encrypted Parquet file (decrypt it with its keys first)",
    b"version https://git-lfs": "a pointer of Git LFS instead of the data (run 'git lfs pull')",
    b"<!DOCTYPE": "a web page instead of the data (a login or an error page was saved)",
    b"<!doctype": "a web page instead of the data (a login or an error page was saved)",
    b"<html": "a web page instead of the data (a login or an error page was saved)",
    b"# Created by Octave": "Octave's own text format (save -v7 writes a MAT file)",
    b"Salted__": "encrypted data (decrypt it first)",
    b"-----BEGIN PGP": "encrypted data (decrypt it first)",
}


def list_suffixes() -> tuple[str, ...]:
    """Return all file endings that can be read, in the order of the registry."""
    return tuple(suffix for part in FORMATS.values() for suffix in part.suffixes)


def is_text_log(path: Path) -> bool:
    """Return whether a file of an ending that measurement tools also give to files of bytes begins as text."""
    try:
        return FORMATS["csv"].claims(_begin(path)[0])
    except (OSError, DataError):
        return False


def export_advice(suffix: str) -> str:
    """Return advice on converting a file with an unsupported ending; empty if missing."""
    return _EXPORT.get(suffix, "")


def format_for(path: Path) -> LogFormat:
    """Return the format for a file ending.

    Raises:
        DataError: no format has this ending; says which are known and how to export the common others.

    A folder with a ``metadata.yaml`` is a ROS 2 bag.
    """
    if is_file_at(path / BAG_MARK):
        return FORMATS["rosbag2"]
    suffix = path.suffix.lower()
    for part in FORMATS.values():
        if suffix in part.suffixes:
            return part
    advice = f"; {_EXPORT[suffix]}" if suffix in _EXPORT else closest(suffix, list_suffixes())
    raise DataError(f"'{path}': files ending in '{suffix}' cannot be read or written{advice}")


def open_log(path: str | Path, signal_map: SignalMap) -> RawLog:
    """Read a log file without conversion of units and time.

    Raises:
        DataError: missing, empty, unreadable or damaged file, or one that is not what its ending says.
    """
    source = Path(path)
    named = format_for(source)
    try:
        if is_folder_at(source):
            return read_apart(named, source, _size_of_folder(source), signal_map)
        head, size = _begin(source)
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"cannot read '{source}': {reason}; check the path and its permissions") from error
    if not head:
        raise DataError(f"'{source}' is empty (0 bytes); copy or export it again")
    # Downloads reserve their room first: zeros instead of a header.
    if not any(head):
        raise DataError(f"'{source}' begins with zeros only; it is half downloaded or damaged: copy it again")
    # Text claims almost anything, so other known kinds are ruled out by name.
    if not named.claims(head) or any(head.startswith(magic) for magic in _OTHERS):
        advice = _EXPORT.get(source.suffix.lower(), "rename it or export it again")
        raise DataError(f"'{source}' is named {source.suffix} but holds {_content(head)}; {advice}")
    return read_apart(named, source, size, signal_map)


def _begin(path: Path) -> tuple[bytes, int]:
    """Return the first bytes of a regular file and its size.

    Other file types are not opened, since that may block or have effects.
    """
    # Before opening: to open a pipe waits, and to open a device may do something.
    _check_regular(path, os.stat(path))
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with open(handle, "rb", buffering=0) as stream:
        status = os.fstat(handle)
        # Again on the handle: the path may name something else by now.
        _check_regular(path, status)
        return stream.read(_HEAD), status.st_size


def _size_of_folder(folder: Path) -> int:
    """Return the bytes of the files of a bag."""
    total = 0
    for entry in entries_of(folder):
        status = status_of(entry)
        if not stat.S_ISDIR(status.st_mode):
            _check_regular(entry, status)
            total += status.st_size
    return total


def _check_regular(path: Path, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise DataError(f"'{path}' is a pipe, a socket or a device; a log is a regular file: save it as one")


def _content(head: bytes) -> str:
    if head.startswith(b"PK\x03\x04") and len(head) > 6 and head[6] & 1:
        return "a password-protected ZIP archive (unpack it with its password first)"
    for magic, text in _OTHERS.items():
        if head.startswith(magic):
            return text
    for part in FORMATS.values():
        if part.claims(head):
            return part.content
    return "binary data of an unknown kind"
