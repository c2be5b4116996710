"""Checks of user arguments: arrays, names, units and recordings; each problem raises one error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, closest, count_of
from edp.logs.read import RATE_TOLERANCE
from edp.logs.units import check_unit
from edp.recording import Recording
from edp.signals import KINDS, Kind
from edp.wording import typed


def check_together(recordings: Sequence[Recording]) -> None:
    """Refuse recordings that do not belong together.

    Raises:
        DataError: there are no recordings, two have one name, or rates or channels differ.
    """
    if not recordings:
        raise DataError("no recordings are left; give at least one")
    first = recordings[0]
    names = [recording.name for recording in recordings]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise DataError(f"recording name(s) {', '.join(twice)} occur twice; give each its own")
    for recording in recordings:
        # Rates from time stamps differ in their last digits; equal within the tolerance is equal.
        if abs(recording.rate_hz - first.rate_hz) > RATE_TOLERANCE * first.rate_hz:
            raise DataError(
                f"mixed rates: '{first.name}' {typed(first.rate_hz)} Hz, '{recording.name}' "
                f"{typed(recording.rate_hz)} Hz; bring "
                "them to one rate"
            )
        ours, theirs = ([(c.name, c.unit) for c in entry.channels] for entry in (first, recording))
        if ours != theirs:
            both = zip(ours, theirs)
            other = next((f"'{a[0]}' ({a[1]}) is '{b[0]}' ({b[1]}) there" for a, b in both if a != b), "")
            counts = f"{len(first.channels)} and {count_of(len(recording.channels), 'channel')}"
            raise DataError(
                f"mixed channels: '{first.name}' and '{recording.name}' differ: {other or counts}; give equal channels "
                "in equal order"
            )


def matrix_of(values: Any, number: int) -> NDArray[Any]:
    """Return array `number` of those that a user gave, ``(time, channel)``.

    Raises:
        DataError: another shape, or no numbers.
    """
    try:
        matrix = np.asarray(values)
    except ValueError as error:  # rows of several lengths
        raise DataError(f"array {number} is no array (time, channel): {error}") from error
    if matrix.ndim != 2 or 0 in matrix.shape:
        advice = "; numpy.column_stack([u, y]) makes one of single channels" if matrix.ndim == 1 else ""
        raise DataError(
            f"array {number} has shape {matrix.shape}; (time, channel) must hold, one array for each recording{advice}"
        )
    # Objects and texts would be turned into numbers by accident, or fail deep inside.
    if matrix.dtype.kind not in "fiub":
        raise DataError(f"array {number} holds {matrix.dtype}; numbers must hold")
    return matrix


def check_width(tables: Sequence[NDArray[Any]], names: Sequence[str]) -> Sequence[NDArray[Any]]:
    """Return the arrays after checking that all have the same channels.

    Raises:
        DataError: one has another number of channels.
    """
    for number, values in enumerate(tables):
        if values.shape[1] != len(names):
            raise DataError(
                f"array {number} has shape {values.shape}; {count_of(len(names), 'channel')} must hold "
                f"({', '.join(names[:8])})"
            )
    return tables


def names_of(names: Sequence[str] | None, usual: list[str], what: str, counted: str) -> list[str]:
    """Return the user's names after a check, or the default names; `what` is the argument, `counted` the kind of name.

    Raises:
        DataError: another number of them, one that is empty or stands twice, or no texts.
    """
    if names is None:
        return usual
    # A text is a sequence of characters, and would name each channel by one letter.
    if isinstance(names, str) or not all(isinstance(name, str) for name in names):
        raise DataError(f"{what} must be a list of texts, one for each of the {counted}")
    if len(names) != len(usual):
        raise DataError(f"{what} has {len(names)} entries for {len(usual)} {counted}; give one for each")
    twice = sorted({name for name in names if list(names).count(name) > 1})
    if twice or "" in names:
        raise DataError(f"{what}: {f'{twice[0]!r} occurs twice' if twice else 'one is empty'}; give each its own")
    return list(names)


def units_of(units: Sequence[str | None] | Mapping[str, str] | None, names: Sequence[str]) -> dict[str, str]:
    """Return the units that a user gave, by channel.

    Raises:
        DataError: another number of them, an unknown channel, an unknown unit, or no texts.
    """
    if units is None:
        return {}
    if isinstance(units, Mapping):
        for name in units:
            if name not in names:
                raise DataError(f"units: there is no channel '{name}'{closest(str(name), names)}")
        pairs = list(units.items())
    else:
        if isinstance(units, str) or len(units) != len(names):
            raise DataError(f"units has {len(units)} entries for {count_of(len(names), 'channel')}; give one for each")
        pairs = [(name, unit) for name, unit in zip(names, units, strict=True) if unit is not None]
    wrong = [name for name, unit in pairs if not isinstance(unit, str)]
    if wrong:
        raise DataError(
            f"units: that of '{wrong[0]}' is no text; give its name, such as {KINDS[Kind.PRESSURE].si_unit}"
        )
    for name, unit in pairs:
        check_unit(unit, f"units, channel '{name}'")
    return dict(pairs)
