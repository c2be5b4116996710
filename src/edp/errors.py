"""Errors that a user can act on: each message names the input, the file or setting, the requirement and the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from edp.wording import figure

MAX_CHARACTERS = 8_000
"""Of a message: two screens. Names and values in it come from files, which may hold a hundred thousand characters."""


class EdpError(Exception):
    """Base of every error that the user can repair; the command line prints it without a traceback.

    A message that is longer than `MAX_CHARACTERS` loses its middle: the file stands at the beginning, the advice at
    the end.

    Attributes:
        exit_code: with which the command line then ends.
    """

    exit_code = 1

    def __init__(self, message: str = "", *others: object) -> None:
        message, half = str(message), MAX_CHARACTERS // 2
        if len(message) > MAX_CHARACTERS:
            message = f"{message[:half]} ... ({len(message) - 2 * half:,} characters left out) ... {message[-half:]}"
        super().__init__(message, *others)


class DataError(EdpError):
    """Invalid recording, channel, unit or time stamp."""


class ConfigError(EdpError):
    """A configuration value, key or combination is not valid."""


class BundleError(EdpError):
    """A bundle on disk is missing, damaged, or of an unknown schema."""


class ExportError(EdpError):
    """Network that the requested export format cannot represent."""


class StorageError(EdpError):
    """Writing or reading a file failed (disk full, read-only folder, missing path)."""


class BusyError(StorageError):
    """Folder in use by another process, which the message names. The exit code means "try again later"."""

    exit_code = 75


class LostError(EdpError):
    """Worker processes that were killed; their results are unknown, so the command must be run again."""

    exit_code = 75


class NotFiniteError(EdpError):
    """A loss, score or result is NaN or infinite."""


SHOWN_CAUSE = 300
"""Characters of what a library says, in a message: some quote the file."""


def brief(error: BaseException | str, most: int = SHOWN_CAUSE) -> str:
    """Return the message of an error on one line of bounded length, or its type if the message is empty.

    The end of a long message is kept: the path of a file often comes first, and the reason last.
    """
    message = " ".join(str(error).split()) or type(error).__name__
    return message if len(message) <= most else f"{message[: most // 3]} ... {message[-2 * most // 3 :]}"


def count_of(count: float | str | None, noun: str) -> str:
    """Return a count with its noun, such as "1 recording" and "2 recordings"; a dash if the count is not known.

    Args:
        count: a number, or its text.
        noun: in the singular; only its last word gets a plural.
    """
    text = count if isinstance(count, str) else figure(count)
    if text == "1":
        return f"1 {noun}"
    if noun.endswith("xis"):
        return f"{text} {noun[:-2]}es"
    if noun.endswith("y") and noun[-2:-1] not in "aeiou":
        return f"{text} {noun[:-1]}ies"
    return f"{text} {noun}{'es' if noun.endswith(('s', 'x', 'ch', 'sh')) else 's'}"


def closest(name: str, options: Iterable[str]) -> str:
    """Return a suffix for a message: ``; did you mean 'x'?`` or ``; known: a, b, c``."""
    known_options = sorted(options)
    lower = {option.lower(): option for option in known_options}
    match = difflib.get_close_matches(name.lower(), list(lower), n=1, cutoff=0.6)
    if match:
        return f"; did you mean '{lower[match[0]]}'?"
    shown = ", ".join(known_options[:12]) + (", ..." if len(known_options) > 12 else "")
    return f"; known: {shown}" if known_options else ""
