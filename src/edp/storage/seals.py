"""Seals: a hash over the content of a JSON file of EDP, in the file itself, checked each time that the file is read.

A seal shows damage and stray edits. It has no key, so it does not stop somebody who means to forge a file.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from typing import Any

HASH = "blake2b"
"""Key of the hash over all other keys of the JSON object."""
_HASH_OF_LINE = re.compile(rf'(?:, )?"{HASH}": "([0-9a-f]{{32}})"}}\Z')
"""Pattern of the hash at the end of a JSON line."""
MAX_UNSEALED = 100
_unsealed: dict[str, None] = {}


def content_digest(content: Mapping[str, object]) -> str:
    """Return the hash over all keys and values of an object except its own hash."""
    # One round through JSON: the hash is over what a reader will see, names of all kinds as text.
    return _digest_of_parsed(json.loads(json.dumps(dict(content), allow_nan=False)))


def _digest_of_parsed(content: Mapping[str, object]) -> str:
    """Return the hash of an object that came from JSON: an index of a million entries is not copied once more."""
    rest = {key: value for key, value in content.items() if key != HASH}
    return digest_of_bytes(json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False).encode())


def digest_of_bytes(data: bytes) -> str:
    """Return the hash of the content of a file, as a header or a result states it."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def sealed(content: Mapping[str, object]) -> dict[str, object]:
    """Return an object with the hash of its content."""
    return {**content, HASH: content_digest(content)}


def unsealed(content: Any, where: str, error: type[Exception]) -> Any:
    """Return an object without its hash, which is checked; anything without a hash is noted and returned.

    Args:
        content: content of a file of EDP.
        where: name of the file in messages.
        error: kind of error to raise.

    Raises:
        Exception: `error`; the content does not match its hash.
    """
    if not isinstance(content, dict):
        return content
    if HASH not in content:
        if len(_unsealed) < MAX_UNSEALED:
            _unsealed[where] = None
        return content
    if content[HASH] != _digest_of_parsed(content):
        raise error(
            f"{where} was changed since EDP wrote it: its content does not match its hash ({HASH}); restore it from a "
            "copy, or give the command that wrote it again"
        )
    return {key: value for key, value in content.items() if key != HASH}


def seal_line(row: Mapping[str, object]) -> str:
    """Return an object as a line of JSON that ends with the hash of the text before it; the object may hold NaN."""
    digest = digest_of_bytes(json.dumps(dict(row)).encode())
    return json.dumps({**row, HASH: digest}) + "\n"


def is_sealed_line(line: str) -> bool:
    """Tell whether a line of JSON holds a hash."""
    return f'"{HASH}":' in line


def check_sealed_line(line: str, where: str, error: type[Exception]) -> None:
    """Check the hash of a line that `seal_line` wrote.

    Args:
        line: line without its end.
        where: name of the line in messages.
        error: kind of error to raise.

    Raises:
        Exception: `error`; the line has no hash, or its text does not match it.
    """
    hash_match = _HASH_OF_LINE.search(line)
    if hash_match is None or hash_match[1] != digest_of_bytes((line[: hash_match.start()] + "}").encode()):
        raise error(
            f"{where} was changed since EDP wrote it: its text does not match its hash ({HASH}); restore the file from "
            "a copy, or give the command that wrote it again"
        )


def files_without_seal() -> list[str]:
    """Return the files without a hash that this process read, and forget them."""
    files = list(_unsealed)
    _unsealed.clear()
    return files
