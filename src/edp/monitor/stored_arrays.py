"""JSON header and its arrays on disk under one hash, for diagnoses and monitor runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from edp.errors import StorageError, brief
from edp.storage import read_bytes, write_bytes, write_json
from edp.storage.headers import read_header
from edp.storage.reading import Table
from edp.storage.seals import HASH, content_digest, digest_of_bytes

Arrays = Mapping[str, NDArray[Any]]
ARRAY_BYTES = 512 * 2**20
"""Maximum size of an array file in bytes. The traces of a day take a tenth of it."""
ARRAYS = "arrays_blake2b"


def write_stored(folder: Path, name: str, header: Mapping[str, object], arrays: Arrays) -> None:
    """Write ``NAME.safetensors`` and ``NAME.json``; the header last.

    Raises:
        StorageError: a file cannot be written.
    """
    data = save({key: np.ascontiguousarray(values) for key, values in arrays.items()})
    write_bytes(folder / f"{name}.safetensors", data)
    whole = dict(header) | {ARRAYS: digest_of_bytes(data)}
    write_json(folder / f"{name}.json", whole)


def read_stored(folder: Path, name: str, schema: int) -> tuple[Table, dict[str, NDArray[Any]]]:
    """Read header and arrays after a check of their hashes; the content is never executed.

    Raises:
        StorageError: missing, damaged, changed, too large, or of another schema.
    """
    file = folder / f"{name}.json"
    header = read_header(file, ("schema", HASH, ARRAYS))
    if type(header["schema"]) is not int or header["schema"] != schema:
        raise StorageError(f"'{file}' has schema {str(header['schema'])[:40]}, this EDP reads {schema}; write it anew")
    if header[HASH] != content_digest(header):
        raise StorageError(f"'{file}' does not match its hash: it was cut off or changed by hand; write it anew")
    data = read_bytes(folder / f"{name}.safetensors", ARRAY_BYTES)
    if digest_of_bytes(data) != header[ARRAYS]:
        raise StorageError(f"'{folder / name}.safetensors' does not match its hash: cut off or changed; write it anew")
    try:
        arrays = load(data)
    except (SafetensorError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise StorageError(f"'{folder / name}.safetensors' is damaged: {brief(error)}; write it anew") from error
    return header, arrays
