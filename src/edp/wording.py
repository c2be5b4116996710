"""Text for values and names: few digits, one precision per column, units next to the value."""

from __future__ import annotations

import itertools
import math
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime

MISSING = "–"
MAX_LABEL = 32
"""Characters of a name in a picture: more leave too little of a panel to the drawing."""
MAX_DIGITS = 4
"""Significant digits of a number with decimals: nothing that is measured here is known better."""
HUGE, TINY = 1e15, 1e-6
"""Sizes beyond which a number is shown with a power of ten."""
FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")
"""With what a spreadsheet takes a cell for a formula."""
HUGE_SHARE = 1e13
"""Share of one from which a percentage is shown with a power of ten."""


def decimals_for(values: Iterable[float | None], significant: int = 3) -> int:
    """Return the number of decimals (0 to 6) for a column whose smallest value has `significant` digits."""
    sizes = [abs(value) for value in values if value is not None and math.isfinite(value) and value != 0]
    if not sizes:
        return 1
    return min(max(significant - 1 - math.floor(math.log10(min(sizes))), 0), 6)


def number(value: float | None, decimals: int | None = None, signed: bool = False) -> str:
    """Return a number as text, with thousands separated and a true minus sign; a dash for None, NaN or infinity.

    Decimals that would be the fifth significant digit or a later one are left out, whatever `decimals` asks for.
    """
    if value is None or not math.isfinite(value):
        return MISSING
    if abs(value) >= HUGE:
        return f"{value:{'+' if signed else ''}.{MAX_DIGITS - 1}g}".replace("-", "−")
    places = min(decimals_for([value]) if decimals is None else decimals, _useful_decimals(value))
    text = f"{value:{'+' if signed else ''},.{places}f}"
    # A rounded zero must not carry a sign.
    if float(text.replace(",", "")) == 0:
        text = text.lstrip("+-")
    return text.replace("-", "−")


def figure(value: float | None, digits: int = MAX_DIGITS) -> str:
    """Return a setting or measured quantity as text: four significant digits, without zeros at the end.

    Whole numbers are shown in full.

    Args:
        value: the quantity.
        digits: fewer significant digits, for quantities that are known less well.
    """
    if value is None or not math.isfinite(value):
        return MISSING
    if 0 < abs(value) < TINY:
        return f"{value:.{min(digits, MAX_DIGITS - 1)}g}".replace("-", "−")
    text = number(value, 0 if float(value).is_integer() else _useful_decimals(value, digits))
    return text.rstrip("0").rstrip(".") if "." in text else text


def typed(value: float | None, digits: int = MAX_DIGITS) -> str:
    """Return a number as a user can type it back into a setting or an option: ASCII, without thousands separators.

    Messages of errors use it: what they advise is copied. Tables, pages and first lines use `figure`.
    """
    if value is None:
        return MISSING
    if math.isfinite(value) and float(value).is_integer() and abs(value) < 1e6:
        return f"{value:.0f}"
    return f"{value:.{digits}g}"


def unit_text(unit: str) -> str:
    """Return a unit for display: empty for dimensionless values, whose unit in files is "1"."""
    return "" if unit == "1" else unit


def behind(unit: str) -> str:
    """Return a unit with a leading space; empty for dimensionless values."""
    return f" {unit_text(unit)}".rstrip()


def quantity(value: float | None, unit: str) -> str:
    """Return a number with its unit, as `number` and `unit_text` show them."""
    return number(value) + behind(unit)


def interval(low: float | None, high: float | None, signed: bool = False) -> str:
    """Return an interval as text, with as many digits as its width gives meaning to: two of the width."""
    places = None if low is None or high is None else interval_decimals(low, high)
    return f"{number(low, places, signed)} to {number(high, places, signed)}"


def interval_decimals(low: float, high: float) -> int:
    """Return the number of decimals, 0 to 6, that shows the width of an interval with two significant digits."""
    return decimals_for([high - low or high], significant=2)


def _useful_decimals(value: float, digits: int = MAX_DIGITS) -> int:
    """Return the number of decimals with which a value has at most `digits` significant digits."""
    # The exponent after rounding: 9.9996 has two digits before the point once it is rounded.
    exponent = int(f"{abs(value):.{digits - 1}e}".partition("e")[2])
    return max(digits - 1 - exponent, 0)


def percent(share: float | None, signed: bool = False) -> str:
    """Return a fraction as a percentage: one decimal below ten percent, otherwise no decimals; a dash if unknown.

    Headlines, first lines, tables and pages show percentages of results by this rule alone.
    """
    if share is None or not math.isfinite(share):
        return "–"
    if abs(share) >= HUGE_SHARE:
        return f"{100 * share:{'+' if signed else ''}.3g} %".replace("-", "−")
    # 0.0995 is where one decimal would round up to ten percent.
    text = f"{100 * share:{'+' if signed else ''},.{1 if abs(share) < 0.0995 else 0}f}"
    # A rounded zero must not carry a sign.
    text = text.lstrip("+-") if float(text.replace(",", "")) == 0 else text
    return text.replace("-", "−") + " %"


def percent_interval(low: float, high: float) -> str:
    """Return an interval of relative changes, such as "−3.1 % to +12 %"."""
    return f"{percent(low, signed=True)} to {percent(high, signed=True)}"


def setting_text(value: object) -> str:
    """Return a setting as text, exactly as it was given; members of a list have commas between them."""
    if isinstance(value, Mapping):
        return "; ".join(f"{key}: {setting_text(inner)}" for key, inner in value.items()) or "none"
    if isinstance(value, list | tuple | set | frozenset):
        return ", ".join(map(setting_text, value)) or "none"
    if value is None or value == "":
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def printable(text: str) -> str:
    """Return text without control characters, turns of direction and halves of characters, each of them as one mark."""
    return "".join(c if c.isprintable() or unicodedata.category(c) == "Zs" else "\ufffd" for c in text)


def printable_lines(text: str) -> str:
    """Replace unprintable characters in a text of several lines, keeping the line breaks."""
    return "\n".join(map(printable, text.split("\n")))


def short_labels(names: Iterable[str], most: int = MAX_LABEL) -> tuple[str, ...]:
    """Return the names of one picture in at most `most` characters each, different where the names differ.

    Of long names that begin and end alike, the part that differs is kept. Equal names are numbered, and so are the few
    that differ in more places than a label holds.
    """
    all_names = list(names)
    labels = _labels(sorted(set(all_names)), most)
    seen: dict[str, int] = {}
    shown = []
    for label in (labels[name] for name in all_names):
        seen[label] = seen.get(label, 0) + 1
        shown.append(label if seen[label] == 1 else f"{label} ({seen[label]})")
    return tuple(shown)


def label_by_name(names: Iterable[str], most: int = MAX_LABEL) -> dict[str, str]:
    """Return `short_labels` by name."""
    distinct = list(dict.fromkeys(names))
    return dict(zip(distinct, short_labels(distinct, most), strict=True))


def _labels(names: list[str], most: int) -> dict[str, str]:
    begin = _count_common_prefix([name for name in names if len(name) > most]) if len(names) > 1 else 0
    labels = {name: _shorten_prefix(name, begin, most) for name in names}
    for label, count in Counter(labels.values()).items():
        alike = [name for name in names if labels[name] == label]
        if count > 1:
            start = _count_common_prefix(alike)
            labels |= {name: _around(name, start, most) for name in alike}
    return labels


def _count_common_prefix(texts: Sequence[str]) -> int:
    """Return the number of characters with which all texts begin."""
    alike = (len(set(letters)) == 1 for letters in zip(*texts, strict=False))
    return sum(1 for _ in itertools.takewhile(bool, alike))


def _shorten_prefix(name: str, begin: int, most: int) -> str:
    """Return a name in at most `most` characters: without most of what all names begin with, or without its middle."""
    if len(name) <= most:
        return name
    head = most // 5
    rest = name[max(begin - 3, 0) :]
    if begin <= 2 * head or begin + head >= len(name):
        return _shorten_middle(name, most)
    return f"{name[:head]}…{_shorten_middle(rest, most - head - 1)}"


def _shorten_middle(name: str, most: int) -> str:
    end = most // 3 + 1
    return name if len(name) <= most else f"{name[: most - 1 - end]}…{name[-end:]}"


def _around(name: str, start: int, most: int) -> str:
    """Return a name in at most `most` characters, with what follows from `start` on, where it differs from others."""
    if len(name) <= most:
        return name
    ends = most // 5
    start = max(start - ends // 2, 0)
    return f"{name[:ends]}…{name[start : start + most - 2 * ends - 2]}…{name[-ends:]}"


def escape_csv(text: str) -> str:
    """Return text for a CSV cell: text that a spreadsheet would run as a formula gets a leading apostrophe."""
    # Numbers with a sign stay numbers; only text can be a formula.
    try:
        float(text)
    except ValueError:
        return f"'{text}" if text.startswith(FORMULA) else text
    return text


def escape_markdown(text: str) -> str:
    """Escape a sentence for Markdown, so that names in it cannot start an element, a link or a line."""
    flat = printable(re.sub(r"[ \t\r\n\f\v]+", " ", text).strip())
    return flat.replace("<", "&lt;").replace("](", "]\\(").replace("][", "]\\[")


def count_text(value: float | None) -> str:
    """Format a count: no decimals, thousands separated."""
    return number(value, 0)


def duration(seconds: float | None) -> str:
    """Format a time span with a suitable unit: s, min or h."""
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
    """Format an ISO 8601 time as ``2026-03-04 10:20 UTC``; other text is returned unchanged."""
    text = str(created or "")
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        return text
    return f"{when:%Y-%m-%d %H:%M} {when.tzname() or ''}".rstrip()


def unbroken(sentence: str) -> str:
    """Return the sentence with non-breaking spaces that keep each number next to its unit and the word before."""
    return re.sub(r"(?<=\d) (?=[a-zA-Z%°]+/?[a-zA-Z]*\b)|(?<=\w) (?=[−\d][\d.,]*(?:;|\.$))", "\u00a0", sentence)


def listed(parts: Iterable[str]) -> str:
    """Join words as ``a``, ``a and b`` or ``a, b and c``."""
    items = list(parts)
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}" if items else ""
