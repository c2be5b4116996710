"""Numbers and names as a reader wants them: few digits, one precision per column, units beside the figure."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable
from datetime import datetime

MISSING = "–"
LABEL_START, LABEL_END = 20, 11
"""Characters of a long name that a picture shows around an ellipsis: 32 in all leave half of a panel to the drawing."""
FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")
"""With what a spreadsheet takes a cell for a formula."""


def decimals_for(values: Iterable[float | None], significant: int = 3) -> int:
    """Decimals that show the smallest non-zero magnitude of a column with `significant` digits, 0 to 6."""
    sizes = [abs(value) for value in values if value is not None and math.isfinite(value) and value != 0]
    if not sizes:
        return 1
    return min(max(significant - 1 - math.floor(math.log10(min(sizes))), 0), 6)


def number(value: float | None, decimals: int | None = None, signed: bool = False) -> str:
    """A figure with thousands separated and a true minus sign; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return MISSING
    places = decimals_for([value]) if decimals is None else decimals
    text = f"{value:{'+' if signed else ''},.{places}f}"
    # A rounded zero must not carry a sign.
    if float(text.replace(",", "")) == 0:
        text = text.lstrip("+-")
    return text.replace("-", "−")


def percent(share: float | None, signed: bool = False) -> str:
    """A share of one as a percentage: one decimal below ten percent, none above."""
    if share is None or not math.isfinite(share):
        return MISSING
    # 0.0995 is where one decimal would round up to ten percent.
    return number(100 * share, 1 if abs(share) < 0.0995 else 0, signed) + " %"


def printable(text: str) -> str:
    """Text without control characters, turns of direction and halves of characters, each of them as one mark."""
    return "".join(c if c.isprintable() or unicodedata.category(c) == "Zs" else "\ufffd" for c in text)


def printable_lines(text: str) -> str:
    """The same for text of several lines."""
    return "\n".join(map(printable, text.split("\n")))


def short_label(name: str) -> str:
    """A name as a picture shows it: at most 32 characters, the middle of a longer one left out."""
    if len(name) <= LABEL_START + 1 + LABEL_END:
        return name
    return f"{name[:LABEL_START]}…{name[-LABEL_END:]}"


def short_labels(names: Iterable[str]) -> tuple[str, ...]:
    """Short names of one picture, distinguished by a number where only the middle differed: axes go by their labels."""
    seen: dict[str, int] = {}
    labels = []
    for label in map(short_label, names):
        seen[label] = seen.get(label, 0) + 1
        labels.append(label if seen[label] == 1 else f"{label} ({seen[label]})")
    return tuple(labels)


def in_cell(text: str) -> str:
    """Text as a cell of a CSV file: what a spreadsheet would take for a formula has an apostrophe in front."""
    # Numbers with a sign stay numbers; only text can be a formula.
    try:
        float(text)
    except ValueError:
        return f"'{text}" if text.startswith(FORMULA) else text
    return text


def in_markdown(text: str) -> str:
    """A sentence in a Markdown document: names in it start no element, link or line."""
    flat = printable(re.sub(r"[ \t\r\n\f\v]+", " ", text).strip())
    return flat.replace("<", "&lt;").replace("](", "]\\(").replace("][", "]\\[")


def count_text(value: float | None) -> str:
    """A count: no decimals, thousands separated."""
    return number(value, 0)


def duration(seconds: float | None) -> str:
    """A time span in the unit a person would say it in."""
    if seconds is None or not math.isfinite(seconds):
        return MISSING
    if seconds == 0:
        return "0 s"
    if seconds < 60:
        return f"{number(seconds)} s"
    if seconds < 3600:
        return f"{seconds / 60:.1f} min"
    return f"{seconds / 3600:.1f} h"


def moment(created: object) -> str:
    """An ISO 8601 time as ``2026-03-04 10:20 UTC``; anything else as it is."""
    text = str(created or "")
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        return text
    return f"{when:%Y-%m-%d %H:%M} {when.tzname() or ''}".rstrip()


def unbroken(sentence: str) -> str:
    """A sentence whose figures stay on one line with the word before and the unit after them."""
    return re.sub(r"(?<=\d) (?=[a-zA-Z%°]+/?[a-zA-Z]*\b)|(?<=\w) (?=[−\d][\d.,]*(?:;|\.$))", "\u00a0", sentence)


def listed(parts: Iterable[str]) -> str:
    """``a``, ``a and b`` or ``a, b and c``."""
    items = list(parts)
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}" if items else ""
