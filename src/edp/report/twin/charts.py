"""A free run along a log as plots: what was measured, and what the twin answered."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edp.recording import Recording
from edp.report.common.chart import BLUE, DROPPED, Chart, ChartAxis, DataSeries, Panel, with_unit
from edp.report.common.picture import write_pictures
from edp.report.common.wording import short_label
from edp.signals import KINDS, Kind

MOST_DRAWN = 4_000
"""Points of a line: more than a picture's width resolves."""
KINDS_DRAWN = {
    "velocities": (Kind.VELOCITY, Kind.ANGULAR_VELOCITY),
    "strokes": (Kind.POSITION, Kind.ANGLE),
    "pressures": (Kind.PRESSURE,),
}


def write_rollout_plots(rollout: Recording, suffix: str, start_s: float, folder: str | Path) -> list[Path]:
    """Write ``velocities``, ``strokes`` and ``pressures`` as SVG and PNG, a row for each channel.

    Args:
        rollout: measured channels, and answers under the same names with `suffix` behind.
        suffix: of the names of answers.
        start_s: time of the log at the first row.
        folder: where to write; it is made.

    Returns:
        the files, in order.

    Raises:
        StorageError: the folder or a file cannot be written.
    """
    charts = []
    for name, kinds in KINDS_DRAWN.items():
        columns = [c.name for c in rollout.channels if c.kind in kinds and f"{c.name}{suffix}" in rollout.channel_names]
        if columns:
            charts.append(_chart(name, rollout, columns, suffix, start_s))
    return write_pictures(folder, charts)


def _chart(name: str, rollout: Recording, columns: list[str], suffix: str, start_s: float) -> Chart:
    # Ends belong to the picture: how far a free run is off in the end is what it shows.
    at = np.unique(np.linspace(0, rollout.samples - 1, MOST_DRAWN).astype(int))
    time_s = start_s + at / rollout.rate_hz
    panels = []
    for column in columns:
        facts = KINDS[rollout.channels[rollout.index(column)].kind]
        measured, answered = (facts.report_factor * rollout.column(n)[at] for n in (column, f"{column}{suffix}"))
        marks = (
            DataSeries(x=time_s, y=measured, name="measured", colour=DROPPED, width=3.6),
            DataSeries(x=time_s, y=answered, name="answered by the twin", colour=BLUE, width=1.4),
        )
        vertical = ChartAxis(with_unit(f"{short_label(column)}\n", facts.report_unit))
        panels.append(Panel(marks, ChartAxis("Time in the log [s]"), vertical))
    size = (8.0, 1.3 * len(columns) + 0.9)
    return Chart(name, tuple(panels), file=name, inches=size, height=90 + 130 * len(columns), together=True)
