"""Evenly spaced segments of series, for computations that cannot hold or need not use all data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from edp.data.gathered import some_rows
from edp.data.series import Series
from edp.recording import spread_stretches


def spread_series(series: Sequence[Series], length: int, most: int, on_disk: bool = False) -> list[Series]:
    """Return the series, or evenly spaced segments of `length` samples with about `most` samples in total.

    Args:
        series: the series.
        length: length of a segment.
        most: approximate total number of samples.
        on_disk: whether rows on disk stay on disk until they are read, instead of being loaded into memory.
    """
    stretches = spread_stretches([part.samples for part in series], length, most)
    return [_cut(series[i], start, stop, on_disk) for i, start, stop in stretches]


def _cut(part: Series, start: int, stop: int, on_disk: bool) -> Series:
    if (start, stop) == (0, part.samples):
        return part
    strategy_columns = None if part.strategy_columns is None else part.strategy_columns[start:stop]
    inputs, targets = (
        some_rows(values, start, stop) if on_disk else values[start:stop] for values in (part.inputs, part.targets)
    )
    name = f"{part.name}[{start}:{stop}]"
    return replace(part, name=name, inputs=inputs, targets=targets, strategy_columns=strategy_columns)
