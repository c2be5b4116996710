"""Warnings about proposals for readable logs: rows that are not samples, a rate that loses motion."""

from __future__ import annotations

from collections.abc import Collection
from itertools import islice
from pathlib import Path

import numpy as np

from edp.errors import DataError
from edp.logs.formats.base import Column
from edp.logs.proposal.clocks import ClockGuess
from edp.logs.proposal.columns import LogLook, names_in_log
from edp.storage.paths import files_below, is_file_at, is_folder_at
from edp.wording import percent, setting_text, typed

_MIN_COLUMNS = 20
"""Minimum number of unnamed columns for rows that may hold samples of one signal."""
_ALIKE, _MOST = 0.97, 0.9
"""Minimum correlation of neighbouring columns that continue each other, and minimum fraction of such neighbours."""

_SLOWER, _LOST, _FEW = 4.0, 0.25, 0.1
"""Required ratio of sample rate to motion frequency; fraction of faster motion above which the user is warned; maximum
fraction at the proposed rate. Eight samples per period are ample; with two, motion between samples is lost.
"""
_MIN_ROWS = 500
_MAX_TEXTS = 8
"""Maximum number of text files examined next to logs with other file endings."""
_RATES_HZ = (200.0, 500.0, 1000.0, 2000.0, 5000.0)


def shape_notes(look: LogLook) -> list[str]:
    """Return warnings that a table is not a log with one channel per column.

    Args:
        look: examined part of the log.
    """
    if look.headerless and len(look.columns) >= _MIN_COLUMNS and _neighbours_continue(look):
        return [
            f"{len(look.columns)} columns without names, each nearly the one before: a row seems to hold samples of "
            "one signal, as a cycle of a test rig does; write one signal a column, its samples below each other"
        ]
    return []


def _neighbours_continue(look: LogLook) -> bool:
    values = np.stack([column.pieces[0] for column in look.columns])
    values = values[:, np.isfinite(values).all(axis=0)]
    if values.shape[1] < 3:
        return False
    moved = values - values.mean(axis=1, keepdims=True)
    size = np.sqrt(np.mean(moved**2, axis=1))
    if not size.all():
        return False
    alike = np.mean(moved[1:] * moved[:-1], axis=1) / (size[1:] * size[:-1])
    return bool(np.mean(alike > _ALIKE) > _MOST)


def pace_notes(look: LogLook, clock: ClockGuess, targets: Collection[str]) -> list[str]:
    """Return a warning if the targets move faster than the reduced rate can represent.

    Args:
        look: examined part of the log.
        clock: time of the rows.
        targets: columns to predict.
    """
    rate, wanted_hz = clock.rate_hz, clock.wanted_hz
    if rate is None or wanted_hz is None or wanted_hz >= rate:
        return []
    pieces = {column.name: column.pieces[0] for column in look.columns if column.name in targets}
    lost = {name: _faster(piece, rate, wanted_hz / _SLOWER) for name, piece in pieces.items()}
    if max(lost.values(), default=0.0) < _LOST:
        return []
    name = max(lost, key=lambda one: lost[one])
    better = next((hz for hz in _RATES_HZ if hz < rate and _faster(pieces[name], rate, hz / _SLOWER) < _FEW), rate)
    return [
        f"{percent(lost[name])} of the motion of {name[:40]} is faster than {typed(wanted_hz / _SLOWER)} Hz, which "
        f"{typed(wanted_hz)} Hz show badly: set rate_hz = {setting_text(better)} in the map if it matters"
    ]


def _faster(values: Column, rate_hz: float, limit_hz: float) -> float:
    """Share of the variance of a column, without its trend, above a frequency."""
    values = values[np.isfinite(values)]
    if len(values) < _MIN_ROWS:
        return 0.0
    rows = np.arange(len(values))
    moved = values - np.polyval(np.polyfit(rows, values, 1), rows)
    power = np.square(np.abs(np.fft.rfft(moved)))
    total = float(power.sum())
    return float(power[np.fft.rfftfreq(len(values), 1.0 / rate_hz) > limit_hz].sum()) / total if total > 0 else 0.0


def note_ignored_files(source: Path, paths: Collection[Path]) -> list[str]:
    """Return warnings about text files with tables that are ignored next to logs of other formats.

    Args:
        source: source that the user named.
        paths: the logs that were found there.
    """
    if not is_folder_at(source) or any(path.suffix.lower() == ".txt" for path in paths):
        return []
    tables = [path for path in sorted(islice(files_below(source, "*.txt"), _MAX_TEXTS)) if _is_table(path)]
    named = ", ".join(path.name[:40] for path in tables[:3])
    return [f"text files beside these logs are not looked at: {named}; give such logs on their own"] if tables else []


def _is_table(path: Path) -> bool:
    try:
        return is_file_at(path) and len(names_in_log(path)) > 1
    except DataError:
        return False
