"""Ranges of settings: every number has a lower and an upper bound; a violation is one error that names the setting."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

from edp.errors import ConfigError

# Sizes of a network: eight times the widest of the thesis (256 units, 4 levels) and more; it must run on a controller.
MAX_UNITS = 4096
MOST_CHANNELS = 4096
MAX_LAYERS = 16
# The dilation doubles from level to level: 16 levels of kernel 2 see 65,536 ticks, as long as the longest window.
MAX_LEVELS = 16
MAX_KERNEL = 1024
# Ten minutes at 100 Hz; what a stream remembers beyond that is a slow drift, which recurrent states carry.
MOST_TICKS = 65_536
# A batch holds at most a month at 100 Hz; the memory that it needs is computed before it is taken.
MAX_BATCH = 1_000_000
# Of targets, horizons, channels, features, terms or names in a list: machines log hundreds, and each is an output.
MAX_NAMES = 10_000
MAX_HORIZONS = 1_000
# Rows or ticks: 115 days at 100 Hz, more than any recording has.
MAX_ROWS = 1_000_000_000
MAX_EPOCHS = 1_000_000
# Of processor time: six milliseconds, in which nothing is trained, and less is a slip of the pen.
MIN_MINUTES = 1e-4
MAX_UPDATES = 1_000_000_000
MAX_THREADS = 4_096
# Of NumPy's RandomState, which Optuna and scikit-learn draw from: 32 bits.
MAX_SEED = 2**32 - 1
# Standardised errors, gradients and weights of loss terms are of the order of one; float32 squares overflow at 1.8e19.
MAX_WEIGHT = 1e6
MIN_POSITIVE = 1.2e-38
"""Least number that counts as above zero: the smallest normal number of float32, whose inverse is finite."""
_checked: dict[type, dict[str, Bound]] = {}
"""Bounds by class of settings, recorded when an object is checked; the reference of settings is made from them."""
MAX_SHOWN = 60
"""Characters of a value that a message repeats."""


@dataclass(frozen=True)
class Bound:
    """From where to where a number may lie.

    Attributes:
        low: least value.
        high: largest value, finite.
        integer: only integers.
        above: `low` itself is out; above zero, numbers below `MIN_POSITIVE` are, too.
        below: `high` itself is out.
    """

    low: float
    high: float
    integer: bool = False
    above: bool = False
    below: bool = False

    def holds(self, value: Any) -> bool:
        """Whether a value is a number within; NaN, infinity, text and truth values are not."""
        # True is an Integral for Python, and no number for a user.
        if isinstance(value, bool) or not isinstance(value, Integral if self.integer else Real):
            return False
        number: Any = value  # integers beyond what a float holds compare as they are
        over = number > self.low if self.above else number >= self.low
        if self.above and self.low == 0.0 and number < MIN_POSITIVE:
            return False
        under = number < self.high if self.below else number <= self.high
        return bool(over and under)

    def rule(self, name: str) -> str:
        """Return the bound as an inequality for error messages."""
        first, second = "<" if self.above else "<=", "<" if self.below else "<="
        kind = "integers, " if self.integer else ""
        return f"{kind}{self.low:,.12g} {first} {name} {second} {self.high:,.12g}"

    def note(self, value: Any) -> str:
        """Return the explanation for a positive number that counts as zero; otherwise an empty text."""
        entries = value if isinstance(value, tuple | list) else (value,)
        tiny = any(isinstance(entry, Real) and 0.0 < entry < MIN_POSITIVE for entry in entries)  # type: ignore[operator]
        return f" (numbers below {MIN_POSITIVE:g} count as zero)" if self.above and self.low == 0.0 and tiny else ""


def integer(low: int, high: int) -> Bound:
    """Integers from `low` to `high`, both included."""
    return Bound(low, high, integer=True)


def span(low: float, high: float) -> Bound:
    """Numbers from `low` to `high`, both included."""
    return Bound(low, high)


def above(low: float, high: float) -> Bound:
    """Numbers above `low`, up to `high`."""
    return Bound(low, high, above=True)


def below(low: float, high: float) -> Bound:
    """Numbers from `low` on, below `high`."""
    return Bound(low, high, below=True)


def between(low: float, high: float) -> Bound:
    """Numbers between `low` and `high`, neither included."""
    return Bound(low, high, above=True, below=True)


SEED = integer(0, MAX_SEED)
SHARE = span(0.0, 1.0)
RATE = above(0.0, 1e38)
"""Of learning: what float32 holds. A rate that is too large for a network is reported as a training that diverged."""
DECAY = span(0.0, 100.0)
"""Of weights, per unit of the learning rate."""
WEIGHT = above(0.0, MAX_WEIGHT)
"""Of a term of a loss."""


def check_bounds(what: str, spec: object, **bounds: Bound) -> None:
    """Raise ConfigError if values of a settings object are outside their bounds. None passes.

    Args:
        what: name of the settings in messages.
        spec: object whose attributes are checked; of tuples and lists every entry.
        bounds: bounds by attribute name.

    Raises:
        ConfigError: every one that is out, with its bound.
    """
    wrong = []
    _checked.setdefault(type(spec), {}).update(bounds)
    for name, bound in bounds.items():
        value = getattr(spec, name)
        entries = value if isinstance(value, tuple | list) else () if value is None else (value,)
        if not all(bound.holds(entry) for entry in entries):
            wrong.append(f"{name} = {shown(value)}; {bound.rule(name)} must hold{bound.note(value)}")
    if wrong:
        raise ConfigError(f"{what}: {'; '.join(wrong)}")


def bounds_of(cls: type) -> Mapping[str, Bound]:
    """Return the bounds of a settings class by attribute; empty before the first object of the class."""
    return dict(_checked.get(cls, {}))


def check_count(what: str, name: str, entries: Sequence[object], most: int, least: int = 0) -> None:
    """Refuse a list that is too long or too short.

    Raises:
        ConfigError: says how long it is and how long it may be.
    """
    if not least <= len(entries) <= most:
        raise ConfigError(f"{what}: {name} has {len(entries):,} entries; {least:,} to {most:,} must hold")


def check_texts(what: str, texts: Iterable[str], longest: int) -> None:
    """Refuse a text that is too long.

    Raises:
        ConfigError: says how long it is and how long it may be.
    """
    length = max(map(len, texts), default=0)
    if length > longest:
        raise ConfigError(f"{what}: a text of {length:,} characters; at most {longest:,} must hold")


def shown(value: Any) -> str:
    """Return a value as text for error messages: long values are cut, huge integers become their number of digits."""
    # str() of an integer of thousands of digits takes quadratic time, and Python refuses it.
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 4 * MAX_SHOWN:
        return f"a number of about {round(value.bit_length() * 0.30103):,} digits"
    if isinstance(value, tuple | list):
        return f"[{_cut(', '.join(shown(entry) for entry in value[:MAX_SHOWN]))}]"
    if isinstance(value, dict):
        return _cut("{" + ", ".join(f"{key!r}: {shown(entry)}" for key, entry in list(value.items())[:MAX_SHOWN]) + "}")
    return _cut(repr(value))


def _cut(text: str) -> str:
    return text if len(text) <= 2 * MAX_SHOWN else f"{text[: 2 * MAX_SHOWN]} ... ({len(text):,} characters)"
