"""A free run along a log as plots: what was measured, and what the twin answered."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from edp.recording import Recording
from edp.report.common.drawing import BLUE, DROPPED, write_drawings
from edp.report.common.wording import short_label
from edp.signals import KINDS, Kind

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_DRAWN = 4_000
"""Points of a line: more than a picture's width resolves."""
KINDS_DRAWN = ((Kind.VELOCITY, Kind.ANGULAR_VELOCITY), (Kind.POSITION, Kind.ANGLE), (Kind.PRESSURE,))
NAMES = ("velocities", "strokes", "pressures")


def write_rollout_plots(rollout: Recording, suffix: str, start_s: float, folder: str | Path) -> list[Path]:
    """Write ``velocities``, ``strokes`` and ``pressures`` as SVG and PNG, a row for each channel.

    Args:
        rollout: measured channels, answers under the same names with `suffix` behind, and the ends of their intervals
            with ``_low`` and ``_high`` behind that, where there are some.
        suffix: of the names of answers.
        start_s: time of the log at the first row.
        folder: where to write; it is made.

    Returns:
        the files, in order.

    Raises:
        StorageError: the folder or a file cannot be written.
    """
    drawings = {}
    for name, kinds in zip(NAMES, KINDS_DRAWN, strict=True):
        columns = [c.name for c in rollout.channels if c.kind in kinds and f"{c.name}{suffix}" in rollout.channel_names]
        if columns:
            drawings[name] = partial(_draw, rollout=rollout, columns=columns, suffix=suffix, start_s=start_s)
    return write_drawings(folder, drawings)


def _draw(figure: Figure, rollout: Recording, columns: list[str], suffix: str, start_s: float) -> None:
    figure.set_size_inches(8.0, 1.3 * len(columns) + 0.9)
    rows: Any = figure.subplots(nrows=len(columns), sharex=True, squeeze=False)
    # Ends belong to the picture: how far a free run is off in the end is what it shows.
    at = np.unique(np.linspace(0, rollout.samples - 1, MOST_DRAWN).astype(int))
    time_s = start_s + at / rollout.rate_hz
    for row, name in enumerate(columns):
        axes, facts = rows[row, 0], KINDS[rollout.channels[rollout.index(name)].kind]
        measured, answered = (facts.report_factor * rollout.column(n)[at] for n in (name, f"{name}{suffix}"))
        ends = [f"{name}{suffix}_{end}" for end in ("low", "high")]
        if all(end in rollout.channel_names for end in ends):
            low, high = (facts.report_factor * rollout.column(end)[at] for end in ends)
            axes.fill_between(time_s, low, high, color=BLUE, alpha=0.15, linewidth=0, label="interval")
        axes.plot(time_s, measured, color=DROPPED, linewidth=2.4, label="measured")
        axes.plot(time_s, answered, color=BLUE, linewidth=0.9, label="answered by the twin")
        axes.set(ylabel=f"{short_label(name)}\n[{facts.report_unit}]")
    rows[0, 0].legend(frameon=False, fontsize=7, ncols=3)
    rows[-1, 0].set(xlabel="Time in the log [s]")
