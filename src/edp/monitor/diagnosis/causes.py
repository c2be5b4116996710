"""Fault classes for the diagnosis: properties of a kind at a site, and the probability of causing an alarm."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

from edp.errors import DataError

AtFault = Literal["sensor", "machine", "none"]
NONE_OF_THESE = "none"
"""Type of a cause that is not in the fault dictionary."""
LONGEST_TEXT = 300
MAX_SIZES = 32


@dataclass(frozen=True)
class FaultClass:
    """Fault kind at a site in one direction; the dictionary holds its signatures.

    Attributes:
        kind: name of the kind.
        site: site of the fault; empty if a machine has only one such component.
        component: the part that a mechanic would look at.
        at_fault: whether the machine or a sensor is at fault.
        unit: unit of the sizes; empty for faults without a size.
        sizes: sizes with signatures in `unit`, ascending and of one sign; empty for faults without a size.
        neutral: the size that is no fault.
        grave: whether a load may fall or a movement may not stop.
        words: a sentence with ``{size}``, ``{high}`` and ``{large}`` where it has a size.
    """

    kind: str
    site: str
    component: str
    at_fault: AtFault
    unit: str
    sizes: tuple[float, ...]
    neutral: float
    grave: bool
    words: str

    @property
    def name(self) -> str:
        """Kind and site, and the sign of negative sizes."""
        sign = ("-",) if self.sizes and self.sizes[0] < self.neutral else ()
        return ":".join((self.kind, *filter(None, (self.site,)), *sign))

    def to_dict(self) -> dict[str, object]:
        """Convert to JSON types."""
        return asdict(self) | {"sizes": list(self.sizes)}


@dataclass(frozen=True)
class Cause:
    """Possible cause of an alarm.

    Attributes:
        kind: name of the kind of fault, or `NONE_OF_THESE`.
        site: site of the fault.
        component: the part that a mechanic would look at; empty for `NONE_OF_THESE`.
        at_fault: whether the machine or a sensor is at fault.
        size: estimated from the evidence, in `unit`; None for faults that are there or not.
        unit: unit of the size.
        probability: 0 to 1, of this cause among all.
        words: a sentence without the probability.
        grade: position of the size on the ladder of its kind, 0 (hardly visible) to 1 (gross); None without sizes.
        grave: whether a load may fall or a movement may not stop.
    """

    kind: str
    site: str = ""
    component: str = ""
    at_fault: AtFault = "none"
    size: float | None = None
    unit: str = ""
    probability: float = 0.0
    words: str = ""
    grade: float | None = None
    grave: bool = False

    def to_dict(self) -> dict[str, object]:
        """Convert to JSON types."""
        return asdict(self)


def class_of(values: Any, where: str) -> FaultClass:
    """Create a fault class from plain data.

    Raises:
        DataError: a value is missing, too long, or of another kind than it must be.
    """
    if not isinstance(values, Mapping) or set(values) != {entry.name for entry in fields(FaultClass)}:
        raise DataError(f"{where}: no fault class; write the dictionary anew")
    for key in ("kind", "site", "component", "unit", "words"):
        if not isinstance(values[key], str) or len(values[key]) > LONGEST_TEXT:
            raise DataError(f"{where}: {key} must be a text of at most {LONGEST_TEXT} characters")
    sizes, neutral = values["sizes"], values["neutral"]
    numbers = [*sizes, neutral] if isinstance(sizes, Sequence) and not isinstance(sizes, str) else [None]
    if len(numbers) > MAX_SIZES or not all(_is_finite(number) for number in numbers):
        raise DataError(f"{where}: sizes and neutral must be at most {MAX_SIZES} finite numbers")
    if values["at_fault"] not in ("sensor", "machine") or not isinstance(values["grave"], bool):
        raise DataError(f"{where}: at_fault must be 'sensor' or 'machine', grave true or false")
    return FaultClass(**{**values, "sizes": tuple(map(float, sizes)), "neutral": float(neutral)})


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
