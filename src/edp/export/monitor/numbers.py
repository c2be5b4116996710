"""The constants of an exported monitor as C, and their checksums."""

from __future__ import annotations

import binascii
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edp.errors import ExportError
from edp.export.c.text import array, filled, number
from edp.export.escape import Code
from edp.export.hashes import little_endian
from edp.export.monitor.golden import usual_widths
from edp.export.monitor.parts import MonitorParts

MOST_PLACES = 2**16 - 1
"""Tables of places are 16 bits wide."""


def double_number(value: float) -> str:
    """Return a C literal with enough digits to restore the same bits.

    Raises:
        ExportError: NaN or infinite, for which C has no literal.
    """
    text = repr(float(value))
    if text.lstrip("-") in ("inf", "nan"):
        raise ExportError(f"a number of the monitor is {value}; fit it again")
    return text if any(c in text for c in ".e") else f"{text}.0"


@dataclass
class MonitorTables:
    """Definitions of constants, and the entries of the checksums at start-up.

    Attributes:
        lines: of C.
        double_entries: of the table of arrays of doubles.
        entries: of the table of other arrays.
        crc: of the doubles.
        other_crc: of the others.
        bytes: of all of them.
    """

    lines: list[str] = field(default_factory=list)
    double_entries: list[str] = field(default_factory=list)
    entries: list[str] = field(default_factory=list)
    crc: int = 0
    other_crc: int = 0
    bytes: int = 0

    def doubles(self, name: str, values: ArrayLike) -> None:
        """Add an array of doubles, row by row."""
        numbers: NDArray[np.float64] = np.asarray(values, dtype=np.float64).ravel()
        self.lines.append(array("double", name, map(double_number, numbers)))
        self.double_entries.append(f"{{{name}, {numbers.size}u}}")
        self.crc = binascii.crc32(little_endian(numbers), self.crc)
        self.bytes += numbers.nbytes

    def singles(self, name: str, values: ArrayLike) -> None:
        """Add an array of doubles with float32 values, stored as floats, since C widens them without loss.

        Raises:
            ExportError: one is none.
        """
        exact: NDArray[np.float64] = np.asarray(values, dtype=np.float64)
        with np.errstate(over="ignore"):
            same = np.array_equal(exact.astype(np.float32).astype(np.float64), exact)
        if not same:
            raise ExportError(f"'{name}' of the monitor holds numbers that are no float32 numbers; fit it again")
        self.floats(name, exact)

    def floats(self, name: str, values: ArrayLike) -> None:
        """Add an array of floats, row by row."""
        numbers: NDArray[np.float32] = np.asarray(values, dtype=np.float32).ravel()
        self.lines.append(array("float", name, map(number, numbers)))
        self._other(name, numbers)

    def places(self, name: str, values: Iterable[int]) -> None:
        """Add an array of 16-bit positions; an empty one gets a single zero, since C has no empty arrays.

        Raises:
            ExportError: a place beyond 16 bits.
        """
        listed = list(values) or [0]
        if max(listed) > MOST_PLACES:
            raise ExportError(f"table '{name}' of the monitor counts to {max(listed):,}; {MOST_PLACES:,} must hold")
        numbers: NDArray[np.uint16] = np.asarray(listed, dtype=np.uint16)
        self.lines.append(array("uint16_t", name, (f"{value}u" for value in listed)))
        self._other(name, numbers)

    def text(self, line: str) -> None:
        """Add a definition that the checksums omit, since it holds pointers or is a struct."""
        self.lines.append(line)

    def _other(self, name: str, numbers: NDArray[np.generic]) -> None:
        self.entries.append(f"{{{name}, {numbers.size}u, {numbers.itemsize}u}}")
        self.other_crc = binascii.crc32(little_endian(numbers), self.other_crc)
        self.bytes += numbers.nbytes

    def finished(self) -> Code:
        """All of it as the text of a header."""
        kind = "typedef struct {\n    const double *values;\n    uint32_t count;\n} double_table;"
        tables = [
            kind,
            array("double_table", "doubles", self.double_entries),
            array("edp_table", "tables", self.entries),
            f"#define TABLES_CRC {self.other_crc}u",
        ]
        return Code("\n".join([*self.lines, *tables]) + "\n")


def golden_header(name: str, monitor: MonitorParts) -> Code:
    """Return the reference values of a self-test as a header."""
    chain, rows = monitor.golden_chain, monitor.golden_residuals
    parts = monitor.chain
    lines = [f"/* What {name} gives in Python: statistics of drawn rows, and residuals of a stretch. */"]
    lines.append(_rows("double", "golden_statistics", chain.statistics))
    for array_name, values in (("golden_alarms", chain.alarms), ("golden_since", chain.since)):
        lines.append(f"static const int32_t {array_name}[{len(values)}] = {{\n{filled(map(str, values))}\n}};")
    lines.append(_array("double", "golden_evidence", chain.evidence))
    for part, widths in zip(("centre", "spread", "scale"), usual_widths(parts), strict=True):
        lines.append(_array("float", f"golden_{part}", widths))
    lines.append(f"#define GOLDEN_TICKS {len(rows.inputs)}u")
    lines.append(_rows("float", "golden_inputs", rows.inputs))
    lines.append(_rows("float", "golden_residuals", rows.residuals))
    lines.append(_array("float", "golden_tolerance", rows.tolerance))
    return Code("\n".join(lines) + "\n")


def _literal(kind: str, value: float) -> str:
    if not np.isfinite(value):
        return "NAN"
    return double_number(value) if kind == "double" else number(value)


def _array(kind: str, name: str, values: np.ndarray) -> Code:
    return Code(f"static const {kind} {name}[{len(values)}] = {{\n{filled(_literal(kind, v) for v in values)}\n}};")


def _rows(kind: str, name: str, rows: np.ndarray) -> Code:
    body = ",\n".join("    {\n" + filled((_literal(kind, v) for v in row), "     ") + "}" for row in rows)
    return Code(f"static const {kind} {name}[{len(rows)}][{rows.shape[1]}] = {{\n{body}\n}};")
