"""Content found in a MAT file, and the first bytes of such files."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC = (b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file")
INFO = "edp_info"
"""Name of the variable with EDP's metadata."""


@dataclass
class Part:
    """One column found: its values and own time in seconds, shape ``(time,)``, and unit."""

    name: str
    values: NDArray[Any]
    time: NDArray[np.float64] | None
    unit: str | None = None
    path: str = ""


@dataclass
class MatVariables:
    """Everything found in a file.

    Attributes:
        signals: the columns; equal times of two columns are one array.
        scalars: single numbers.
        repeated: names that several columns have, with the names that tell them apart.
        names: names of the variables.
        info: EDP's data, a text; None where the file has none.
        experiments: experiments of one ``iddata``; if there are several, each is read separately.
        experiment_names: names of those that stand beside each other in one variable (``train{1}``).
    """

    signals: list[Part] = field(default_factory=list)
    scalars: dict[str, float] = field(default_factory=dict)
    repeated: dict[str, list[str]] = field(default_factory=dict)
    names: list[str] = field(default_factory=list)
    info: str | None = None
    experiments: int = 1
    experiment_names: list[str] = field(default_factory=list)


def is_v4(head: bytes) -> bool:
    """Return whether a file begins with a v4 header."""
    if len(head) < 20:
        return False
    # v4 has no magic number; its five integers must be sound in one of both byte orders.
    for order in ("<", ">"):
        kind, rows, columns, imaginary, name = (int(x) for x in np.frombuffer(head[:20], dtype=f"{order}i4"))
        digits = [int(digit) for digit in f"{kind:04d}"] if 0 <= kind < 5000 else []
        sizes_fit = rows >= 0 and columns >= 0 and imaginary in (0, 1) and 1 < name < 64
        if digits and digits[1] == 0 and digits[2] <= 5 and digits[3] <= 2 and sizes_fit:
            text = head[20 : 20 + name]
            return len(text) == name and text.endswith(b"\0") and text[:1].isalpha()
    return False
