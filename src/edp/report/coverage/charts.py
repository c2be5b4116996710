"""Figures of a data set's coverage: spectrum, excitation by lags, poses, joint histograms."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edp.data.coverage import Coverage, Occupancy
from edp.data.spectrum import FLAT_DB
from edp.report.common.chart import (
    DASHES,
    LINES,
    SOFT,
    Cells,
    Chart,
    ChartAxis,
    DataSeries,
    GuideLine,
    Mark,
    Panel,
    Texts,
    append_unit,
)  # fmt: skip
from edp.wording import figure, label_by_name

MAX_AXIS = 22
"""Maximum number of characters of an axis name. Three panels form a row."""
TINT = "#eef4fe"
SCALE = (TINT, "#b7d0f7", "#6d9fec", "#2567d3", "#062c74")
"""Colour scale of one hue from light to dark. Darker cells have more samples; empty cells are white."""
GROUPS = {
    "command": "joint_command",
    "head pressure": "joint_head",
    "rod pressure": "joint_rod",
    "velocities": "joint_velocities",
}
DECADES = 4
"""Number of decades of the colour scale for fractions. Cells below them are practically empty."""


def coverage_charts(coverage: Coverage) -> list[Chart]:
    """Return the figures for which the data set has data."""
    charts = [spectrum_chart(coverage), excitation_chart(coverage), occupancy_chart(coverage.occupancy)]
    charts += [joint_chart(coverage, group) for group in GROUPS]
    return [chart for chart in charts if chart is not None]


def spectrum_chart(coverage: Coverage) -> Chart | None:
    """Return the power spectral density of each command in dB below its maximum, with the band that should be flat."""
    inputs = coverage.spectrum
    if inputs is None or not len(inputs.frequency_hz):
        return None
    marks: list[Mark] = [GuideLine(y=-FLAT_DB, to=3.0, colour=TINT), GuideLine(x=inputs.used_hz, dash="dot")]
    for i, name in enumerate(inputs.names):
        peak = inputs.density[:, i].max()
        if not peak > 0:
            continue
        # -90 dB: the floor keeps the logarithm finite where a bin is empty.
        level = 10.0 * np.log10(np.maximum(inputs.density[:, i] / peak, 1e-9))
        marks.append(DataSeries(
            x=inputs.frequency_hz.astype(np.float32), y=level.astype(np.float32), width=2.2 if i == 0 else 1.6,
            name=f"{name}, flat to {inputs.flat_to_hz[i]:.2g} Hz", colour=LINES[i % len(LINES)],
            dash=DASHES[i % len(DASHES)], hover="{x:.3g} Hz: {y:.1f} dB", remark="",
        ))  # fmt: skip
    flat_up_to = f"wanted: within {figure(FLAT_DB)} dB up to {inputs.used_hz:.2g} Hz"
    marks.append(Texts(x=[inputs.used_hz], y=[-FLAT_DB], texts=[flat_up_to], raised=True, colour=SOFT))
    up = ChartAxis("Density below its maximum [dB]", limits=(-60.0, 3.0))
    return Chart("spectrum", (Panel(tuple(marks), ChartAxis("Frequency [Hz]", kind="log"), up),), height=360)


def excitation_chart(coverage: Coverage) -> Chart | None:
    """Return the smallest singular value of the input Hankel matrix against the number of lags."""
    if len(coverage.singular) < 2:
        return None
    lags = list(coverage.singular)
    values = [max(value, 1e-9) for value in coverage.singular.values()]
    marks = (
        GuideLine(y=1.0, dash="dot"),
        DataSeries(x=lags, y=values, width=2.2, symbol="circle", hover="{x} lags: {y:.3g}", remark=""),
        Texts(x=[0.0], y=[1.0], texts=["white noise"], raised=True, colour=SOFT),
    )
    # Whole decades below, and room for the words above one.
    limits = (float(10.0 ** (np.floor(np.log10(min(values))) - 0.1)), 10.0**0.4)
    up = ChartAxis("Smallest singular value", kind="log", limits=limits)
    panel = Panel(marks, ChartAxis("Lags [samples]", from_zero=True), up)
    return Chart("excitation", (panel,), height=320, legend="none")


def occupancy_chart(occupancy: Occupancy | None) -> Chart | None:
    """Time in each cell of the strokes: a map of the last two for each cell of the first."""
    if occupancy is None:
        return None
    samples = occupancy.samples
    maps = list(samples.reshape(-1, *samples.shape[-2:])) if samples.ndim > 1 else [samples.reshape(1, -1)]
    shares = [100.0 * part / max(samples.sum(), 1) for part in maps]
    low, high = occupancy.span[0]
    edges = np.linspace(low, high, samples.shape[0] + 1)
    titles = (
        [f"{a:.2f} to {b:.2f} m" for a, b in itertools.pairwise(np.round(edges, 2) + 0.0)] if len(maps) > 1 else [""]
    )
    names = label_by_name(occupancy.names, MAX_AXIS)
    if len(maps) > 1:
        titles[0] = f"{names[occupancy.names[0]]}\n{titles[0]}"
    upright = _centres(occupancy, -2) if samples.ndim > 1 else [0.0]
    up = ChartAxis(f"{names[occupancy.names[-2]]} [m]" if samples.ndim > 1 else "", grid=False, shown=samples.ndim > 1)
    fullest = int(np.argmax([share.max() for share in shares]))
    top = float(shares[fullest].max())
    panels = []
    for index, (title, share) in enumerate(zip(titles, shares, strict=False)):
        cells = _cells(_centres(occupancy, -1), upright, share, top, "% of the time", "{label:.2f} % of the time")
        across = ChartAxis("" if index else f"{names[occupancy.names[-1]]} [m]")
        barred = index == fullest
        panels.append(
            Panel((replace(cells, barred=barred, gap=True),), across, replace(up, title="") if index else up, title)
        )
    equal = (1.0 / len(panels),) * len(panels)
    return Chart("occupancy", tuple(panels), columns=len(panels), shares=equal, height=310, legend="none")


def joint_chart(coverage: Coverage, group: str) -> Chart | None:
    """Return joint histograms of one kind side by side: fraction of samples on a logarithmic scale."""
    joints = [joint for joint in coverage.joints if joint.group == group][:6]
    if not joints:
        return None
    columns = min(len(joints), 3)
    shares = [100.0 * joint.counts.T / max(joint.counts.sum(), 1) for joint in joints]
    top = max(float(share.max()) for share in shares)
    names = label_by_name((name for joint in joints for name in (joint.x, joint.y)), MAX_AXIS)
    panels: list[Panel] = []
    for joint, share in zip(joints, shares, strict=True):
        x, y = _middles(joint.x_range, share.shape[1]), _middles(joint.y_range, share.shape[0])
        cells = _cells(x, y, share, top, "% of the samples", "{x:.4g}, {y:.4g}: {label:.3f} %")
        title = f"correlation {joint.correlation:.2f}, {joint.information:.2f} nat".replace("-", "−")
        panels.append(Panel(
            (replace(cells, barred=len(panels) == 0),), ChartAxis(append_unit(names[joint.x], joint.x_unit)),
            ChartAxis(append_unit(names[joint.y], joint.y_unit), grid=False), title,
        ))  # fmt: skip
    height = 60 + 270 * -(-len(joints) // columns)
    return Chart(GROUPS[group], tuple(panels), columns=columns, height=height, legend="none")


def _cells(x: list[float], y: list[float], share: NDArray[np.float64], top: float, unit: str, hover: str) -> Cells:
    """Return decades above a ten-thousandth of the fullest cell; cells without samples are white."""
    floor = top * 10.0**-DECADES
    level = np.log10(np.maximum(share, floor) / max(floor, 1e-30))
    ticks = tuple((float(tick), f"{top * 10.0 ** (tick - DECADES):.2g}") for tick in range(DECADES + 1))
    return Cells(
        x=x, y=y, values=np.where(share > 0, level, np.nan), shown=share, scale=SCALE, ends=(0.0, float(DECADES)),
        unit=unit.replace(" of", "\nof"), ticks=ticks, hover=hover, remark="",
    )  # fmt: skip


def _centres(occupancy: Occupancy, axis: int) -> list[float]:
    low, high = occupancy.span[axis]
    return _middles((low, high), occupancy.samples.shape[axis])


def _middles(ends: tuple[float, float], count: int) -> list[float]:
    edges = np.linspace(*ends, count + 1)
    return [float(f"{value:.4g}") for value in 0.5 * (edges[1:] + edges[:-1])]
