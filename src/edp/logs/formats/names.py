"""Names of columns where a file has groups, topics or variables: short where that is clear, else with the place."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from edp.logs.formats.base import RawSignal

Named = tuple[dict[str, RawSignal], dict[str, str], dict[str, list[str]]]


def told_apart(named_signals: Sequence[tuple[str, RawSignal]]) -> Named:
    """Return the columns by name.

    Args:
        named_signals: the full name of each column (with group or topic), and the column under its short name.

    Returns:
        columns under their short names where those occur once, else under the full ones, numbered where even those
        occur twice; the full names of the former; and the short names of the latter with their full ones.
    """
    counts = Counter(signal.name for _, signal in named_signals)
    often = {name for name, count in counts.items() if count > 1}
    once = counts.keys() - often
    signals: dict[str, RawSignal] = {}
    aliases: dict[str, str] = {}
    repeated: dict[str, list[str]] = {}
    numbers: Counter[str] = Counter()
    for name, signal in named_signals:
        full = name
        if signal.name not in often:
            signals[signal.name] = signal
            aliases[full] = signal.name
            continue
        # A full name may be the short name of another column.
        while full in signals or full in once:
            numbers[name] += 1
            full = f"{name}#{numbers[name] + 1}"
        signals[full] = replace(signal, name=full)
        repeated.setdefault(signal.name, []).append(full)
    return signals, aliases, repeated


def name_of_file(path: Path) -> str:
    r"""Return the name of a recording from its file name; bytes that are not UTF-8 become ``\xff``."""
    return path.stem.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def only(
    chosen_names: Iterable[str], signals: Mapping[str, RawSignal], repeated: Mapping[str, Sequence[str]]
) -> tuple[dict[str, RawSignal], dict[str, list[str]]]:
    """Return the selected columns of a log in the given order, and names that several columns have."""
    chosen_signals = {name: signals[name] for name in chosen_names if name in signals}
    among = {name: [full for full in several if full in chosen_signals] for name, several in repeated.items()}
    return chosen_signals, {name: several for name, several in among.items() if len(several) > 1}


SHOWN = 80
"""Maximum number of characters of a name in a message."""


def quote_name(name: str) -> str:
    """Return a quoted name for a message: shortened, with control characters escaped."""
    return repr(name if len(name) <= SHOWN else name[: SHOWN - 3] + "...")
