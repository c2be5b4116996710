"""Tables of constants in C with the checksums that the code compares at start-up."""

from __future__ import annotations

import binascii
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edp.errors import ExportError
from edp.export.c.text import array, double_number, number, table, unsigned_literals
from edp.export.escape import Code
from edp.export.hashes import little_endian

MAX_PLACES = 2**16 - 1
"""Maximum index in a table of indices, whose entries have 16 bits."""
DOUBLE_TABLE = "typedef struct {\n    const double *values;\n    uint32_t count;\n} double_table;"


@dataclass
class ConstantTables:
    """Definitions of constants, and the entries of their checksums.

    Attributes:
        owner: word for what the constants belong to, in messages.
        lines: lines of C.
        double_entries: entries of the table of arrays of doubles.
        entries: entries of the table of other arrays.
        double_crc: CRC-32 of the doubles so far.
        crc: CRC-32 of the others so far.
        bytes: total size of the arrays.
    """

    owner: str
    lines: list[str] = field(default_factory=list)
    double_entries: list[str] = field(default_factory=list)
    entries: list[str] = field(default_factory=list)
    double_crc: int = 0
    crc: int = 0
    bytes: int = 0

    def doubles(self, name: str, values: ArrayLike) -> None:
        """Add an array of doubles, row by row."""
        numbers: NDArray[np.float64] = np.asarray(values, dtype=np.float64).ravel()
        self.lines.append(array("double", name, map(double_number, numbers)))
        self.double_entries.append(f"{{{name}, {numbers.size}u}}")
        self.double_crc = binascii.crc32(little_endian(numbers), self.double_crc)
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
            raise ExportError(f"'{name}' of the {self.owner} holds numbers that are no float32 numbers; fit it again")
        self.floats(name, exact)

    def floats(self, name: str, values: ArrayLike) -> None:
        """Add an array of floats, row by row."""
        numbers: NDArray[np.float32] = np.asarray(values, dtype=np.float32).ravel()
        self.lines.append(array("float", name, map(number, numbers)))
        self._enter(name, numbers)

    def rows(self, name: str, values: ArrayLike) -> None:
        """Add an array of rows of floats, shape (row, value)."""
        numbers: NDArray[np.float32] = np.asarray(values, dtype=np.float32)
        rows, width = numbers.shape
        self.lines.append(table("float", f"{name}[{rows}][{width}]", (map(number, row) for row in numbers)))
        self._enter(name, numbers)

    def places(self, name: str, values: Iterable[int]) -> None:
        """Add an array of 16-bit counts or positions; an empty one gets a single zero, since C has no empty arrays.

        Raises:
            ExportError: a place beyond 16 bits.
        """
        listed = list(values) or [0]
        if max(listed) > MAX_PLACES:
            raise ExportError(f"table '{name}' of the {self.owner} counts to {max(listed):,}; {MAX_PLACES:,} must hold")
        self.lines.append(array("uint16_t", name, unsigned_literals(listed)))
        self._enter(name, np.asarray(listed, dtype=np.uint16))

    def text(self, line: str) -> None:
        """Add a definition that the checksums omit, since it holds pointers or is a struct."""
        self.lines.append(line)

    def _enter(self, name: str, numbers: NDArray[np.generic]) -> None:
        self.entries.append(f"{{{name}, {numbers.size}u, {numbers.itemsize}u}}")
        self.crc = binascii.crc32(little_endian(numbers), self.crc)
        self.bytes += numbers.nbytes

    def finished(self) -> Code:
        """Return all of it as the text of a header; the checksum of doubles is a second one where there are any."""
        lines, entries = list(self.lines), array("edp_table", "tables", self.entries)
        if self.double_entries:
            doubles = array("double_table", "doubles", self.double_entries)
            lines += [DOUBLE_TABLE, doubles, entries, f"#define TABLES_CRC {self.crc}u"]
        else:
            lines.append(entries)
        return Code("\n".join(lines) + "\n")
