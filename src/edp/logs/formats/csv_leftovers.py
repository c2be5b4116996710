"""Detection of CSV lines that are not data: header lines repeated by a restarted logger, and footers."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

_PIECE_BYTES = 1 << 20
"""Size of the text examined or passed on at a time."""
_TAIL_BYTES = 1 << 16
"""Number of bytes at the end of a file in which its last lines are searched."""
MAX_LAST_LINES = 10
"""Maximum number of lines after the table."""
_MIN_ROWS = 2
"""Minimum number of table rows in a file with lines after the table."""
_ONE_BYTE_LINE_ENDS = ("utf-8", "utf-8-sig", "latin-1", "cp1252", "ascii")
"""Encodings in which a line ends with the ASCII byte for a line end."""
MARK = "\x1c"
"""First character of a substitute for a skipped line. The substitute has an extra cell, because the parser does not
count empty lines.
"""
_NUMBER = re.compile(rb"\s*[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?\s*")
_CONTROL = re.compile(rb"[\x00-\x08\x0e-\x1f]")


@dataclass(frozen=True)
class Leftovers:
    """Lines of a file that are skipped.

    Attributes:
        names: lines above the table that stand within it again, without the blanks around them.
        first: number of the first of these, counted from 1; None where there is none.
        end: bytes of the file up to the end of its table.
        end_line: number of the first line behind the table; None where the table ends the file.
    """

    names: frozenset[bytes]
    first: int | None
    end: int
    end_line: int | None

    def __bool__(self) -> bool:
        """Return whether there is anything to pass over."""
        return self.first is not None or self.end_line is not None


def leftovers_of(path: Path, encoding: str, delimiter: str, skip: int, width: int) -> Leftovers:
    """Search a file for lines that are not rows.

    Args:
        path: the file.
        encoding: encoding of the file.
        delimiter: between its cells.
        skip: lines above the table.
        width: cells of a row.
    """
    size = path.stat().st_size
    if encoding not in _ONE_BYTE_LINE_ENDS:
        return Leftovers(frozenset(), None, size, None)
    mark = delimiter.encode()
    end = _end_of_table(path, size, mark, skip, width)
    names: set[bytes] = set()
    first = end_line = None
    number = position = 0
    with path.open("rb") as stream:
        while lines := stream.readlines(_PIECE_BYTES):
            for line in lines:
                number += 1
                if position >= end and end_line is None:
                    end_line = number
                position += len(line)
                bare = line.strip()
                if number <= skip and _is_names(bare, mark, width):
                    names.add(bare)
                elif number > skip and first is None and bare in names:
                    first = number
    return Leftovers(frozenset(names), first, end, end_line)


def _is_names(line: bytes, mark: bytes, width: int) -> bool:
    cells = line.split(mark)
    return len(cells) == width and not any(_NUMBER.fullmatch(cell) for cell in cells)


def _end_of_table(path: Path, size: int, mark: bytes, skip: int, width: int) -> int:
    """Return the size without a footer: last lines of text in too few cells, or a last line with control characters."""
    with path.open("rb") as stream:
        start = stream.seek(max(size - _TAIL_BYTES, 0))
        tail = stream.read()
    lines = tail.splitlines(keepends=True)[0 if start == 0 else 1 :]
    last = max((index for index, line in enumerate(lines) if line.strip()), default=0)
    cut = len(lines)
    if lines and _CONTROL.search(lines[last]):
        # Power went while this line was written.
        cut = last
    # Words right below the first line are no end of a table but a text that is none.
    first = skip + _MIN_ROWS if start == 0 else 0
    for index in range(max(len(lines) - MAX_LAST_LINES, first), cut):
        cells = [cell for cell in lines[index].split(mark) if cell.strip()]
        words = cells and not any(_NUMBER.fullmatch(cell) for cell in cells)
        if words and len(lines[index].split(mark)) < width:
            cut = index
            break
    return size - sum(map(len, lines[cut:]))


class PassedText(io.RawIOBase):
    """A text that is changed while it is read, some lines at a time.

    Args:
        stream: the text.
    """

    def __init__(self, stream: IO[Any]) -> None:
        super().__init__()
        self._stream = stream
        self._rest = b""

    def readable(self) -> bool:
        """Return True, since the stream can be read."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer with the available text."""
        while not self._rest:
            text = self._convert_block()
            if text is None:
                return 0
            self._rest = text
        count = min(len(buffer), len(self._rest))
        buffer[:count] = self._rest[:count]
        self._rest = self._rest[count:]
        return count

    def close(self) -> None:
        """Close the file."""
        self._stream.close()
        super().close()

    def _convert_block(self) -> bytes | None:
        """Return the next lines after filtering; None at the end of the text."""
        raise NotImplementedError


class TableText(PassedText):
    """Text of a table with `MARK` lines in place of repeated headers, up to the end of the table.

    Args:
        path: the text.
        skip: lines above the table, which stay.
        delimiter: between its cells.
        width: cells of a row.
        leftovers: lines to skip.
    """

    def __init__(self, path: Path, skip: int, delimiter: str, width: int, leftovers: Leftovers) -> None:
        super().__init__(path.open("rb"))
        self._left = leftovers.end
        self._skip = skip
        self._names = leftovers.names
        self._marked = (MARK + delimiter * width + "\n").encode()

    def _convert_block(self) -> bytes | None:
        lines = self._stream.readlines(min(_PIECE_BYTES, self._left)) if self._left > 0 else []
        text = bytearray()
        for line in lines:
            above = self._skip > 0
            self._skip -= above
            if self._left > 0:
                text += line if above or line.strip() not in self._names else self._marked
            self._left -= len(line)
        return bytes(text) if lines else None
