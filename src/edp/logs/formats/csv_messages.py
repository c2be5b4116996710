"""Tables of messages: a row has the few columns that came at its time, the others are empty.

So write tools for streams and CAN buses. A table of which any column but time is filled in most rows is none: there an
empty cell is a missing value.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pyarrow as pa

from edp.logs.formats.base import Column, RawSignal, load_column
from edp.logs.formats.csv_table import CsvTable

_SPARSE, _SPARSE_ROWS = 0.5, 1000
"""Maximum fraction of rows filled by a sparse column, and number of rows after which sparse columns are ruled out."""


def message_columns(table: CsvTable) -> set[int]:
    """Return the places of the columns of a table of messages; empty for any other table."""
    layout = table.layout
    numeric = [i for i, key in enumerate(table.keys) if table.types[key] != pa.string() and layout.names[i]]
    filled = dict.fromkeys(numeric, 0)
    rows = 0
    for batch in table.stream([table.keys[i] for i in numeric]):
        for column, i in zip(batch.columns, numeric):
            filled[i] += batch.num_rows - column.null_count
        rows += batch.num_rows
        # The time column is filled; where another one is, it is a usual table.
        if rows >= _SPARSE_ROWS and sum(count > _SPARSE * rows for count in filled.values()) > 1:
            return set()
    sparse = {i for i, count in filled.items() if 0 < count <= _SPARSE * rows}
    full = sum(count > _SPARSE * rows for count in filled.values())
    return sparse if len(sparse) > 1 and full <= 1 else set()


def drop_empty_rows(table: CsvTable, column_index: int, name: str, time: Column) -> RawSignal:
    """Return a column reduced to the rows that contain a number."""
    values = load_column(table, str(column_index), table.rows)
    present = np.isfinite(values)
    values = values[present]
    return RawSignal(
        name, partial(np.asarray, values), len(values), time[present], unit=table.layout.units[column_index]
    )
