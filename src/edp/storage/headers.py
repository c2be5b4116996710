"""Headers of folders with arrays: a hash of the header, and a digest of each file that it names."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from edp.errors import StorageError
from edp.storage.paths import is_file_at
from edp.storage.reading import JSON_BYTES, Table, object_with, parse_json, read_bytes, read_text
from edp.storage.run_kinds import RUN_KINDS
from edp.storage.seals import HASH, content_digest, digest_of_bytes

ARRAYS_BYTES = 2**30
"""Maximum size of an array file in bytes, which is enough for the weights of 250 million parameters."""
FILES = "files"
"""Key in a JSON file of the hashes of the accompanying files."""
_ENTRY = {"file", HASH}


def read_header(file: str | Path, keys: Iterable[str] = ()) -> Table:
    """Return a header with its hash, which is not checked: headers of several schemas state it differently.

    Raises:
        StorageError: the file cannot be read, is not JSON, holds no object, or lacks one of the keys.
    """
    return object_with(parse_json(read_text(file, JSON_BYTES), f"'{file}'"), keys, f"'{file}'")


def digests_of(folder: str | Path, *names: str) -> dict[str, str]:
    """Return the hashes of accompanying files, by name, for the key `FILES` of a JSON file."""
    return {name: digest_of_bytes(read_bytes(Path(folder, name), ARRAYS_BYTES)) for name in names}


def check_files(files: object, folder: str | Path, advice: str) -> None:
    """Raise an error if an accompanying file does not match its hash in the JSON file.

    Args:
        files: value of `FILES`, hashes by name, see `digests_of`; empty in a file of an earlier version.
        folder: folder of the JSON file.
        advice: advice for the message.

    Raises:
        StorageError: a file is missing, or was changed or replaced since, or `files` has another form.
    """
    if not isinstance(files, Mapping):
        raise StorageError(
            f"'{folder}': got {type(files).__name__} as hashes of files, expected a table by name; {advice}"
        )
    for name, digest in files.items():
        file = Path(folder, Path(str(name)).name)  # never a path out of the folder
        if digest_of_bytes(read_bytes(file, ARRAYS_BYTES)) != digest:
            raise StorageError(f"'{file}' was changed since it was written with the result beside it; {advice}")


def model_digest(path: str | Path) -> str:
    """Return a content hash of a model on disk: hash of its header, or of the file.

    Args:
        path: a run folder, the folder of a network, twin or monitor, or a file such as an FMU.

    Raises:
        StorageError: there is no model, or the file cannot be read.
    """
    models = [kind.model for kind in RUN_KINDS.values() if kind.model]
    headers = [Path(path, name) for model in models for name in (model, Path(model).name)]
    file = next((header for header in headers if is_file_at(header)), Path(path))
    return digest_of_bytes(read_bytes(file, ARRAYS_BYTES))


def is_whole(file: Path) -> bool:
    """Return whether a header and its files are unchanged according to their digests.

    Headers from before they had a hash are held to their files alone.

    Raises:
        StorageError: a file cannot be read, is no regular one or too large, or the header is no JSON object.
    """
    header = read_header(file)
    if HASH in header and header[HASH] != content_digest(header):
        return False
    for entry in _entries(header):
        name = Path(str(entry["file"])).name  # never a path out of the folder
        if digest_of_bytes(read_bytes(file.parent / name, ARRAYS_BYTES)) != entry[HASH]:
            return False
    return True


def _entries(header: Mapping[str, object]) -> Iterator[Mapping[str, object]]:
    """Yield the entries of the header and its parts that name a file of arrays."""
    parts = [value for value in header.values() if isinstance(value, dict)]
    within = [value for part in parts for value in part.values() if isinstance(value, dict)]
    yield from (part for part in (*parts, *within) if part.keys() == _ENTRY)
