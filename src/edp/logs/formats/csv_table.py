"""The rows of a text file as columns: all at once where it is small, else block by block."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as arrow_csv
from numpy.typing import NDArray

from edp.errors import DataError, brief
from edp.logs.formats.base import BEHIND_TABLE, NAMES_AGAIN, PIECE_ROWS, TORN_LINE
from edp.logs.formats.csv_leftovers import MARK, Leftovers, PassedText, TableText, leftovers_of
from edp.storage.memory import free_bytes

WHOLE_BYTES = 1 << 30
"""Maximum size of a file that is parsed once and stored. Longer files are parsed once for checking and once per
reading.
"""
_WHOLE_SHARE = 0.25
"""Maximum fraction of free memory for a file in memory."""
_WIDEST = 4
"""Memory in bytes per byte of text: a digit and a delimiter become an eight-byte number."""
_TRIES = 8
"""Maximum number of parses stopped by text in a numeric column. After the second, all columns are examined at once."""
NULLS = ["", "NaN", "nan", "NAN", "NA", "N/A", "#N/A", "null", "NULL", "-nan", "-nan(ind)", "1.#QNAN"]
"""Spellings of a missing value, those of Excel, pandas, MATLAB and C runtimes among them."""
_SQUEEZED_BYTES = 1 << 20
"""Size of the text in which runs of blanks are reduced at a time."""
_LONGEST_LINE = 1 << 26
"""Maximum number of characters of a line before the table."""
_BLOCK_BYTES = 1 << 24
"""Size of the text parsed at a time."""


@dataclass(frozen=True)
class TextLayout:
    """Layout of a text file: its columns with units, and the position of the first numeric row."""

    names: tuple[str, ...]
    units: tuple[str | None, ...]
    numeric: tuple[bool, ...]
    delimiter: str
    decimal: str
    skip_rows: int
    encoding: str


def is_number(cell: str, decimal: str = ".") -> bool:
    """Return whether a cell is a number or empty."""
    text = cell.strip()
    if text in NULLS:
        return True
    try:
        float(text.replace(decimal, ".") if decimal != "." else text)
    except ValueError:
        return False
    return True


_ON, _OFF = ("true", "on", "yes", "ein", "wahr"), ("false", "off", "no", "aus", "falsch")
"""Lower-case words for the states of a switch."""
_PREFIXES = {"": 1.0, "p": 1e-12, "n": 1e-9, "u": 1e-6, "µ": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6, "G": 1e9}
_WITH_PREFIX = r"^(?P<number>[-+]?[0-9]+(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?)(?P<prefix>[pnuµmkMG]?)$"
_REMARKS, _FEW_REMARKS = 0.001, 10
"""Maximum fraction of rows that end in a remark, or number of such rows in a short table."""
_GROUPED = r"[-+]?[0-9]{1,3}(\.[0-9]{3})+(,[0-9]+)?"
_GERMAN = rf"^({_GROUPED}|[-+]?[0-9]*,?[0-9]+([eE][-+]?[0-9]+)?)$"


def is_grouped(cell: str) -> bool:
    """Return whether a cell, without blanks around it, has points for thousands: ``1.234`` or ``1.234,5``."""
    return re.fullmatch(_GROUPED, cell) is not None


def has_decimal_commas(rows: list[list[str]], delimiter: str) -> bool:
    """Return whether the comma is the decimal sign; a point may then part thousands."""
    cells = [cell.strip() for row in rows for cell in row]
    # 1.234,5 says it whatever stands elsewhere.
    if any("," in cell and is_grouped(cell) for cell in cells):
        return True
    with_comma = [cell for cell in cells if re.fullmatch(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?", cell)]
    with_point = [cell for cell in cells if re.fullmatch(r"[-+]?\d*\.\d+(?:[eE][-+]?\d+)?", cell)]
    # 1,234 may have a comma for thousands; 1,5 has none.
    proven = not all(re.fullmatch(r"[-+]?\d{1,3},\d{3}", cell) for cell in with_comma)
    if with_point or delimiter == ",":
        return proven and all(map(is_grouped, with_point))
    return bool(with_comma)


def _parse_without_groups(cells: pa.Array) -> pa.Array | None:
    """Parse values with decimal comma and thousands points; None if a text is neither a number nor missing."""
    cells = pc.utf8_trim_whitespace(cells)
    cells = pc.if_else(pc.is_in(cells, pa.array(NULLS)), pa.scalar(None, pa.string()), cells)
    if not pc.all(pc.match_substring_regex(cells, _GERMAN)).as_py() and cells.null_count < len(cells):
        return None
    plain = pc.replace_substring(pc.replace_substring(cells, ".", ""), ",", ".")
    return pc.cast(pc.replace_substring_regex(plain, r"^\+", ""), pa.float64())


def _parse_switch(cells: pa.Array) -> pa.Array | None:
    """Convert switch states to 0 and 1; None if a text is not a state."""
    cells = pc.utf8_lower(pc.utf8_trim_whitespace(cells))
    missing = pc.is_in(cells, pa.array([text.lower() for text in NULLS]))
    on, off = pc.is_in(cells, pa.array(_ON)), pc.is_in(cells, pa.array(_OFF))
    if not pc.all(pc.or_(pc.or_(on, off), missing), min_count=0).as_py():
        return None
    return pc.if_else(missing, pa.scalar(None, pa.float64()), pc.cast(on, pa.float64()))


def _parse_scaled(cells: pa.Array) -> pa.Array | None:
    """Parse values with an SI prefix as suffix (``25.1m``), as instrument panels write them.

    None for other text.
    """
    cells = pc.utf8_trim_whitespace(cells)
    cells = pc.if_else(pc.is_in(cells, pa.array(NULLS)), pa.scalar(None, pa.string()), cells)
    if cells.null_count == len(cells) or not pc.all(pc.match_substring_regex(cells, _WITH_PREFIX)).as_py():
        return None
    parts = pc.extract_regex(cells, _WITH_PREFIX)
    numbers = pc.cast(pc.replace_substring_regex(pc.struct_field(parts, "number"), r"^\+", ""), pa.float64())
    places = pc.index_in(pc.struct_field(parts, "prefix"), pa.array(list(_PREFIXES)))
    return pc.multiply(numbers, pc.take(pa.array(list(_PREFIXES.values())), places))


def _all_numbers(cells: pa.Array, nulls: pa.Array, decimal: str) -> bool:
    cells = pc.utf8_trim_whitespace(cells)
    cells = pc.if_else(pc.is_in(cells, nulls), pa.scalar(None, pa.string()), cells)
    if decimal != ".":
        cells = pc.replace_substring(cells, decimal, ".")
    try:
        pc.cast(cells, pa.float64())
    except pa.ArrowInvalid:
        return False
    return True


class SqueezedText(PassedText):
    """The lines of a text behind the first ones, as UTF-8, blanks at their ends left out and those within them one.

    Args:
        path: the text.
        encoding: encoding of the text.
        skip: lines before the table.
    """

    def __init__(self, path: Path, encoding: str, skip: int) -> None:
        super().__init__(path.open(encoding=encoding, errors="replace", newline=None))
        for _ in range(skip):
            self._stream.readline(_LONGEST_LINE)

    def _convert_block(self) -> bytes | None:
        lines = self._stream.readlines(_SQUEEZED_BYTES)
        return "".join(" ".join(line.split()) + "\n" for line in lines).encode() if lines else None


class CsvTable:
    """The columns of a text file; a column goes by its place.

    Raises:
        DataError: a row with too few or too many cells, or text that is no table.
    """

    def __init__(self, path: Path, layout: TextLayout) -> None:
        self.path = path
        self.layout = layout
        self.keys = [f"c{i}" for i in range(len(layout.names))]
        self.types = {key: pa.float64() if number else pa.string() for key, number in zip(self.keys, layout.numeric)}
        self.kept: pa.Table | None = None
        self.rows = 0
        self.ragged: list[Any] = []
        self.torn_line: int | None = None
        self.leftovers: Leftovers | None = None
        size = path.stat().st_size
        small = size <= WHOLE_BYTES and _WIDEST * size <= _WHOLE_SHARE * free_bytes()
        for tried in range(_TRIES):
            self.ragged.clear()
            try:
                if small:
                    self.kept = arrow_csv.read_csv(self.source(), *self.options(self.keys))
                    self.rows = self.kept.num_rows
                else:
                    self.rows = sum(batch.num_rows for batch in self.stream(self.keys))
            except (pa.ArrowException, OSError, ValueError) as error:
                column = re.search(r"CSV column #(\d+)", str(error))
                if column is None or self.types[self.keys[int(column[1])]] == pa.string():
                    raise DataError(f"'{path}' cannot be read as CSV: {brief(error)}") from error
                if self.pass_over():
                    continue
                # Text further down a column of numbers: keep it as text, so that only a map that needs it is refused.
                self.types[self.keys[int(column[1])]] = pa.string()
                if tried:
                    self.find_texts()
                continue
            if self.ragged and self.pass_over():
                continue
            self.refuse_ragged()
            return
        raise DataError(f"'{path}' cannot be read as CSV: its columns hold numbers and text in turn")

    @property
    def facts(self) -> dict[str, int]:
        """Line numbers of the first skipped lines, by reason."""
        left_out = {TORN_LINE: self.torn_line}
        if self.leftovers is not None:
            left_out |= {NAMES_AGAIN: self.leftovers.first, BEHIND_TABLE: self.leftovers.end_line}
        return {fact: line for fact, line in left_out.items() if line is not None}

    def pass_over(self) -> bool:
        """Search for lines that are not rows, once. Returns whether some of them were read as rows before."""
        if self.leftovers is not None or self.layout.delimiter == " ":
            return False
        layout = self.layout
        self.leftovers = leftovers_of(self.path, layout.encoding, layout.delimiter, layout.skip_rows, len(layout.names))
        return bool(self.leftovers)

    def find_texts(self) -> None:
        """Find all columns that contain text in later rows in one pass. One parse per column would be quadratic."""
        numeric = [key for key in self.keys if self.types[key] != pa.string()]
        self.types |= dict.fromkeys(numeric, pa.string())
        texts: set[str] = set()
        nulls = pa.array(NULLS)
        for batch in self.stream(numeric):
            for key in numeric:
                if key not in texts and not _all_numbers(batch.column(key), nulls, self.layout.decimal):
                    texts.add(key)
        self.types |= {key: pa.float64() for key in numeric if key not in texts}

    def options(self, keys: Sequence[str]) -> tuple[Any, Any, Any]:
        """Return the pyarrow options for reading the given columns."""

        def note(row: Any) -> str:
            if not row.text.startswith(MARK):
                self.ragged.append(row)
            return "skip"

        layout = self.layout
        # pyarrow skips the byte-order mark of UTF-8 by itself; other encodings pass through Python, slowly.
        encoding = "utf-8" if layout.encoding == "utf-8-sig" else layout.encoding
        # What parts columns by blanks begins at the table, and comes as UTF-8.
        squeezed = layout.delimiter == " "
        read = arrow_csv.ReadOptions(
            # Threads take memory that the sandbox counts, and errors would name no row.
            use_threads=False,
            column_names=self.keys,
            skip_rows=0 if squeezed else layout.skip_rows,
            encoding="utf-8" if squeezed else encoding,
            block_size=_BLOCK_BYTES,
        )
        parse = arrow_csv.ParseOptions(delimiter=layout.delimiter, invalid_row_handler=note)
        convert = arrow_csv.ConvertOptions(
            column_types=self.types, null_values=NULLS, decimal_point=layout.decimal, include_columns=list(keys)
        )
        return read, parse, convert

    def source(self) -> Any:
        """Return the file, its table part, or its rows with single blanks between cells."""
        layout = self.layout
        if self.leftovers:
            return TableText(self.path, layout.skip_rows, layout.delimiter, len(layout.names), self.leftovers)
        return SqueezedText(self.path, layout.encoding, layout.skip_rows) if layout.delimiter == " " else self.path

    def stream(self, keys: Sequence[str]) -> Iterator[pa.RecordBatch]:
        """Yield blocks of rows of the given columns, from the file or the cache."""
        if self.kept is not None:
            yield from self.kept.select(list(keys)).to_batches(max_chunksize=PIECE_ROWS)
            return
        with arrow_csv.open_csv(self.source(), *self.options(keys)) as reader:
            yield from reader

    def pieces(self, names: Sequence[str], start: int, stop: int) -> Iterator[list[NDArray[Any]]]:
        """See `edp.logs.formats.base.ColumnTable`."""
        places = [int(name) for name in names]
        keys = [self.keys[column_index] for column_index in places]
        texts = [column_index for column_index in places if self.types[self.keys[column_index]] == pa.string()]
        grouped = {self.keys[column_index]: column_index for column_index in texts}
        first = 0
        for batch in self.stream(list(dict.fromkeys(keys))):
            low, high = max(start - first, 0), min(stop - first, batch.num_rows)
            if high > low:
                part = batch.slice(low, high - low)
                columns = {key: self._parse_grouped(part.column(key), at) for key, at in grouped.items()}
                arrays = [columns[key] if key in columns else part.column(key) for key in keys]
                yield [np.asarray(array.to_numpy(zero_copy_only=False), dtype=np.float64) for array in arrays]
            first += batch.num_rows
            if first >= stop:
                return

    def _parse_grouped(self, cells: pa.Array, column_index: int) -> pa.Array:
        """Parse a text column with thousands points, or with the states of a switch."""
        numbers = _parse_without_groups(cells) if self.layout.decimal == "," else None
        numbers = _parse_switch(cells) if numbers is None else numbers
        numbers = _parse_scaled(cells) if numbers is None and self.layout.decimal == "." else numbers
        if numbers is None:
            self.refuse_text(column_index)
        return numbers

    def parse_grouped_numbers(self, column_index: int) -> NDArray[np.float64] | None:
        """Return a text column as values with thousands points, shape ``(rows,)``; None if it is not numeric."""
        if self.layout.decimal != ",":
            return None
        parts = [_parse_without_groups(batch.column(0)) for batch in self.stream([self.keys[column_index]])]
        if any(part is None or part.null_count == len(part) for part in parts):
            return None
        columns = [
            np.asarray(part.to_numpy(zero_copy_only=False), dtype=np.float64) for part in parts if part is not None
        ]
        return np.concatenate(columns) if columns else None

    def texts(self, column_index: int) -> list[str | None]:
        """Return the cells of a text column."""
        key = self.keys[column_index]
        return [cell for batch in self.stream([key]) for cell in batch.column(key).to_pylist()]

    def _is_remark(self, row: Any) -> bool:
        """Return whether a row has words behind its last column, as loggers note events; such rows are left out."""
        behind = row.text.split(self.layout.delimiter)[row.expected_columns :]
        return bool(behind) and all(re.search(r"[^\W\d_]{2}", cell) and '"' not in cell for cell in behind)

    def _is_torn(self, row: Any) -> bool:
        """Return whether a row has too few cells, and the file ends within it."""
        if row.actual_columns >= row.expected_columns:
            return False
        end = row.text.encode(self.layout.encoding.removesuffix("-sig"), errors="replace")
        with self.path.open("rb") as stream:
            size = stream.seek(0, io.SEEK_END)
            stream.seek(max(size - len(end), 0))
            return bool(end) and stream.read() == end

    def refuse_ragged(self) -> None:
        damaged = [row for row in self.ragged if not self._is_remark(row)]
        # A logger that was switched off leaves its last row unfinished: no row of the table.
        if damaged and self._is_torn(damaged[-1]):
            self.torn_line = damaged.pop().number
            self.ragged = [row for row in self.ragged if row.number != self.torn_line]
        if damaged or len(self.ragged) > max(_FEW_REMARKS, _REMARKS * self.rows):
            bad = (damaged or self.ragged)[0]
            raise DataError(
                f"'{self.path}': line {bad.number} has {bad.actual_columns} cells, the header has "
                f"{bad.expected_columns} ('{bad.text[:60]}'); the file may be cut off: export it again or delete "
                "the line"
            )

    def refuse_text(self, column_index: int) -> None:
        """Raise the error that names the first text in a column of values."""
        name, row, key = self.layout.names[column_index], self.layout.skip_rows + 1, self.keys[column_index]
        for batch in self.stream([key]):
            for cell in batch.column(key).to_pylist():
                text = (cell or "").strip()
                other_form = is_grouped(text) if self.layout.decimal == "," else re.fullmatch(_WITH_PREFIX, text)
                if not is_number(text, self.layout.decimal) and not other_form:
                    raise DataError(
                        f"'{self.path}': column '{name}' holds text '{text[:40]}' in line {row}; "
                        "expected a number or an empty cell"
                    )
                row += 1
        raise DataError(
            f"'{self.path}': column '{name}' holds numbers that cannot be read; check the decimal sign in the map"
        )
