"""Headers of folders with arrays beside them: a hash over the header, and a digest of each file that it names."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from edp.storage.reading import read_bytes, read_object

HASH = "blake2b"
"""Key of the hash over the rest of the header."""
ARRAYS_BYTES = 2**30
"""Most that a file of arrays has; the weights of 250 million parameters."""
_ENTRY = {"file", HASH}


def header_digest(header: Mapping[str, Any]) -> str:
    """Hash over all of a header but its hash: what is fed and predicted, and in which order, is under it."""
    # One round through JSON: the hash is over what a reader will see, tuples as lists.
    plain = json.loads(json.dumps({key: value for key, value in header.items() if key != HASH}, allow_nan=False))
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"))
    return arrays_digest(text.encode())


def arrays_digest(data: bytes) -> str:
    """Digest of a file of arrays, as a header states it."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def is_whole(file: Path) -> bool:
    """Whether a header and the files that it names are as they were written, as far as digests tell.

    Headers from before they had a hash are held to their files alone.

    Raises:
        StorageError: a file cannot be read, is no regular one or too large, or the header is no JSON object.
    """
    header = read_object(file)
    if HASH in header and header[HASH] != header_digest(header):
        return False
    for entry in _entries(header):
        name = Path(str(entry["file"])).name  # never a path out of the folder
        if arrays_digest(read_bytes(file.parent / name, ARRAYS_BYTES)) != entry[HASH]:
            return False
    return True


def _entries(header: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """What names a file of arrays: in the header, or in one of its parts."""
    parts = [value for value in header.values() if isinstance(value, dict)]
    within = [value for part in parts for value in part.values() if isinstance(value, dict)]
    yield from (part for part in (*parts, *within) if part.keys() == _ENTRY)
