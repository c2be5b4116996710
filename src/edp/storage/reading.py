"""Reading EDP's own kinds of files within bounds.

Settings, manifests, scores and headers may come from a stranger or from a damaged disk. They are read from regular
files only, up to a size, a depth and a number of digits; what is beyond ends in one message, never in a hang.
"""

from __future__ import annotations

import json
import math
import os
import re
import stat
import tomllib
from collections import Counter
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

from edp.errors import StorageError
from edp.storage.portable import BINARY, QUIETLY
from edp.storage.seals import unsealed

Table = dict[str, Any]
"""Table of a TOML file or object of a JSON file whose values nothing has checked yet."""
JSON_BYTES = 64 * 2**20
"""Maximum size of a JSON file in bytes. EDP does not write larger ones."""
SETTINGS_BYTES = 4 * 2**20
"""Maximum size of a TOML file in bytes. Reading a file of this size takes seconds."""
DEPTH = 60
"""Maximum nesting depth of tables and lists. EDP's own files need 10."""
DIGITS = 40
"""Maximum number of digits of an integer. The 128-bit state of a random generator takes 39."""
_KEY = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
DEEP_KEY = re.compile(rf"(?:^|[\[{{,])[ \t]*+{_KEY}(?:[ \t]*+\.[ \t]*+{_KEY}){{{DEPTH}}}", re.MULTILINE)
"""Dotted key with more than `DEPTH` parts. The standard library takes cubic time in the number of parts to read it."""


def read_bytes(path: str | Path, limit: int, where: str = "", error: type[Exception] = StorageError) -> bytes:
    """Return the content of a regular file, or of a link to one. Pipes and devices are refused.

    Args:
        path: path of the file.
        limit: most bytes; a larger file is refused before its bytes are read.
        where: name of the file in messages.
        error: kind of error to raise.

    Raises:
        Exception: `error`; missing, unreadable, not a regular file, or too large.
    """
    where = where or f"'{path}'"
    try:
        _check_regular(os.stat(path), limit, where, error)  # opening a device may already do something
        # Not blocking: a pipe that took the file's place since then would be waited for.
        handle = os.open(path, os.O_RDONLY | QUIETLY | BINARY)
        with open(handle, "rb", buffering=0) as stream:
            _check_regular(os.fstat(handle), limit, where, error)
            parts, size = [], 0
            # One byte beyond the limit is enough to refuse a file that grows while it is read.
            while part := stream.read(min(2**20, limit + 1 - size)):
                parts.append(part)
                size += len(part)
    except OSError as failure:
        raise error(f"{where} cannot be read: {failure.strerror or failure}") from failure
    except ValueError as failure:  # a NUL in the path
        raise error(f"{where} cannot be read: {failure}") from failure
    if size > limit:
        raise error(_too_large(where, size, limit))
    return b"".join(parts)


def _check_regular(status: os.stat_result, limit: int, where: str, error: type[Exception]) -> None:
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe, socket or device"
        raise error(f"{where} cannot be read: it is {kind}; a regular file must be there")
    if status.st_size > limit:
        raise error(_too_large(where, status.st_size, limit))


def _too_large(where: str, size: int, limit: int) -> str:
    return f"{where} cannot be read: it has {size:,} bytes or more, and a file of this kind at most {limit:,}"


def read_text(path: str | Path, limit: int, where: str = "", error: type[Exception] = StorageError) -> str:
    """Return the text of a regular file in UTF-8; see `read_bytes`.

    Raises:
        Exception: `error`; not readable, too large, not UTF-8, or with a byte-order mark in front.
    """
    where = where or f"'{path}'"
    try:
        return read_bytes(path, limit, where, error).decode("utf-8")
    except UnicodeDecodeError as failure:
        raise error(f"{where} cannot be read: not UTF-8 ({failure.reason} at byte {failure.start})") from failure


def read_json(path: str | Path, where: str = "", error: type[Exception] = StorageError) -> Any:
    """Return the content of a JSON file of EDP; see `parse_json`. A hash of the content is checked and left out.

    Raises:
        Exception: `error`; the file is missing, unreadable, beyond its bounds, not JSON, or changed since it was
            written.
    """
    where = where or f"'{path}'"
    return unsealed(parse_json(read_text(path, JSON_BYTES, where, error), where, error), where, error)


def read_object(
    path: str | Path, keys: Iterable[str] = (), where: str = "", error: type[Exception] = StorageError
) -> Table:
    """Read a JSON file that holds one object.

    Args:
        path: path of the file.
        keys: required keys.
        where: name of the file in messages.
        error: kind of error to raise.

    Raises:
        Exception: `error`; as `read_json`, or it holds something else.
    """
    where = where or f"'{path}'"
    return object_with(read_json(path, where, error), keys, where, error)


def object_with(value: Any, keys: Iterable[str], where: str, error: type[Exception] = StorageError) -> Table:
    """Return `value`, which is checked to be an object with these keys.

    Raises:
        Exception: `error`; the message says what it is, or which keys it lacks.
    """
    if not isinstance(value, dict):
        kind = {type(None): "null", list: "a list", str: "a text"}.get(type(value), "a value")
        raise error(f"{where} is damaged: it holds {kind} where an object must be; restore it or write it again")
    missing = [key for key in keys if key not in value]
    if missing:
        raise error(f"{where} is damaged: it lacks {', '.join(missing)}; restore it or write it again")
    return value


def parse_json(text: str, where: str, error: type[Exception] = StorageError, finite: bool = True) -> Any:
    """Parse a JSON text.

    Args:
        text: the JSON.
        where: name of the text in messages.
        error: kind of error to raise.
        finite: refuse NaN and infinity, which are not JSON; Python writes them all the same.

    Raises:
        Exception: `error`; not JSON, nested too deep, a key twice in an object, or a number beyond all use.
    """
    try:
        _refuse_mark(text)
        real = _finite if finite else float
        value = json.loads(text, object_pairs_hook=_distinct, parse_int=_whole, parse_float=real, parse_constant=real)
        _check_tree(value)
    except RecursionError as failure:
        raise error(f"{where} is not valid JSON: nested deeper than {DEPTH}") from failure
    except ValueError as failure:
        raise error(f"{where} is not valid JSON ({failure}); it may be cut off or edited by hand") from failure
    return value


def read_toml(
    path: str | Path, where: str = "", error: type[Exception] = StorageError, advice: str = ""
) -> dict[str, object]:
    """Read a TOML file; see `parse_toml`.

    Args:
        path: path of the file.
        where: name of the file in messages.
        error: kind of error to raise.
        advice: added to the message of a file that cannot be read.

    Raises:
        Exception: `error`; the file is missing, unreadable, beyond its bounds, or not TOML.
    """
    where = where or f"'{path}'"
    try:
        text = read_text(path, SETTINGS_BYTES, where, error)
    except error as failure:
        raise error(f"{failure}{advice}") from failure
    return parse_toml(text, where, error)


def parse_toml(text: str, where: str, error: type[Exception] = StorageError) -> dict[str, object]:
    """Parse a TOML text.

    Raises:
        Exception: `error`; not TOML, nested too deep, or a number beyond all use.
    """
    try:
        _refuse_mark(text)
        # Before the parser, which is what such a key is made to stall.
        if DEEP_KEY.search(text) is not None:
            raise ValueError(f"a key of more than {DEPTH} parts")
        table = tomllib.loads(text)
        _check_tree(table)
    except RecursionError as failure:
        raise error(f"{where} is not valid TOML: nested deeper than {DEPTH}") from failure
    except ValueError as failure:  # TOMLDecodeError, too
        raise error(f"{where} is not valid TOML: {failure}") from failure
    return table


def _refuse_mark(text: str) -> None:
    if text.startswith("\ufeff"):
        raise ValueError("it begins with a byte-order mark; save it as UTF-8 without one")


def _distinct(pairs: Collection[tuple[str, object]]) -> dict[str, object]:
    table = dict(pairs)
    if len(table) < len(pairs):
        twice = next(name for name, count in Counter(name for name, _ in pairs).items() if count > 1)
        raise ValueError(f"the key {twice[:40]!r} stands twice in one object")
    return table


def _whole(text: str) -> int:
    # int() of thousands of digits takes quadratic time; one more character is the sign.
    if len(text) > DIGITS + 1:
        raise ValueError(f"a number of {len(text)} digits; at most {DIGITS} must hold")
    return int(text)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {text[:40]} is not finite")
    return value


def _check_tree(value: Any) -> None:
    """Raise an error for values nested too deeply, and for integers that are too large."""
    level, bound = [value], 10**DIGITS
    for _ in range(DEPTH + 1):
        below: list[Any] = []
        for part in level:
            if isinstance(part, dict):
                below.extend(part.values())
            elif isinstance(part, list):
                below.extend(part)
            elif isinstance(part, int) and abs(part) > bound:
                raise ValueError(f"a number of more than {DIGITS} digits")
        if not below:
            return
        level = below
    raise ValueError(f"nested deeper than {DEPTH}")
