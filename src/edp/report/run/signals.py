"""Raw signals of a test recording, as the network reads them: what a person looks at before any score."""

from __future__ import annotations

import numpy as np

from edp.report.common.chart import BLUE, SHADES, Chart, ChartAxis, DataSeries, Mark, Panel, with_unit
from edp.report.run.facts import INPUTS, Facts
from edp.report.run.figures import downsample
from edp.signals import display_offset
from edp.wording import short_labels

MOST_PANELS, MOST_SERIES = 6, 7
"""Units that have a panel, and signals in one: more lines nobody tells apart."""
POINTS = 1500
"""Of a signal."""


def signal_chart(facts: Facts) -> Chart | None:
    """The inputs over the time of one recording, a panel a unit; None where none were kept."""
    name = next((name for name, parts in sorted(facts.predictions.items()) if INPUTS in parts), None)
    channels = (facts.scores or {}).get(INPUTS, ())
    if name is None or not channels:
        return None
    values, rate = facts.predictions[name][INPUTS], facts.rate_hz or 1.0
    by_unit: dict[str, list[int]] = {}
    for column, channel in enumerate(channels):
        # Numbers without a unit have no common axis: each stands alone.
        by_unit.setdefault(channel["unit"] if channel["unit"] != "1" else f"1 {column}", []).append(column)
    panels, names = [], short_labels(channel["name"] for channel in channels)
    for columns in list(by_unit.values())[:MOST_PANELS]:
        unit = channels[columns[0]]["unit"]
        marks: list[Mark] = []
        labels = [names[column] for column in columns[:MOST_SERIES]]
        for label, column, colour in zip(labels, columns, (BLUE, *SHADES)):
            y = np.asarray(values[:, column] * channels[column]["factor"] + display_offset(unit), dtype=np.float32)
            selected = downsample(y, POINTS)
            x = (selected / rate).astype(np.float32)
            marks.append(DataSeries(x=x, y=y[selected], name=label, colour=colour, width=1.2))
        more = f", {len(columns) - MOST_SERIES} more not drawn" if len(columns) > MOST_SERIES else ""
        title = labels[0] if unit == "1" else with_unit("", unit).strip() + more
        panels.append(Panel(tuple(marks), ChartAxis("Time [s]" if facts.rate_hz else "Sample"), title=title))
    return Chart("signals", tuple(panels), height=100 + 150 * len(panels), together=True)


def signals_of(facts: Facts) -> str:
    """The recording whose signals are drawn; empty where there is none."""
    return next((name for name, parts in sorted(facts.predictions.items()) if INPUTS in parts), "")
