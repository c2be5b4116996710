"""Pictures of what a data set covers: spectrum, excitation by lags, poses, joint histograms."""

from __future__ import annotations

import html
import itertools

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from edp.data.coverage import Coverage, JointHistogram, Occupancy
from edp.data.spectrum import FLAT_DB
from edp.report.common.style import BLUE, INK, MUTED, RULE, SOFT, Plot, styled, with_unit

SCALE = [[0.0, "#eef4fe"], [0.25, "#b7d0f7"], [0.5, "#6d9fec"], [0.75, "#2567d3"], [1.0, "#062c74"]]
"""One hue from the page's tint to dark: more samples, more ink; empty cells stay white."""
LINES = (BLUE, *MUTED)
DASHES = ("solid", "dash", "dot", "dashdot")
GROUPS = {
    "command": "joint_command",
    "head pressure": "joint_head",
    "rod pressure": "joint_rod",
    "velocities": "joint_velocities",
}


def coverage_plots(coverage: Coverage) -> dict[str, Plot]:
    """Every picture that a data set has data for, by name."""
    plots = [spectrum_plot(coverage), excitation_plot(coverage), occupancy_plot(coverage.occupancy)]
    plots += [joint_plot(coverage, group) for group in GROUPS]
    return {plot.name: plot for plot in plots if plot is not None}


def spectrum_plot(coverage: Coverage) -> Plot | None:
    """Power spectral density of each command in dB below its maximum, with the band that should be flat."""
    inputs = coverage.spectrum
    if inputs is None or not len(inputs.frequency_hz):
        return None
    figure = go.Figure()
    figure.add_hrect(y0=-FLAT_DB, y1=3.0, fillcolor="#eef4fe", line_width=0, layer="below")
    for i, name in enumerate(inputs.names):
        peak = inputs.density[:, i].max()
        if not peak > 0:
            continue
        # -90 dB: the floor keeps the logarithm finite where a bin is empty.
        level = 10.0 * np.log10(np.maximum(inputs.density[:, i] / peak, 1e-9))
        figure.add_scatter(
            x=inputs.frequency_hz.astype(np.float32),
            y=level.astype(np.float32),
            name=f"{html.escape(name)}, flat to {inputs.flat_to_hz[i]:.2g} Hz",
            mode="lines",
            line={"color": LINES[i % len(LINES)], "width": 2.2 if i == 0 else 1.6, "dash": DASHES[i % len(DASHES)]},
            hovertemplate="%{x:.3~g} Hz: %{y:.1f} dB<extra></extra>",
        )
    figure.add_vline(x=inputs.used_hz, line={"color": SOFT, "width": 1, "dash": "dot"})
    styled(figure, 360)
    figure.add_annotation(
        x=np.log10(inputs.used_hz),
        y=-FLAT_DB,
        text=f"wanted: within {FLAT_DB:g} dB up to {inputs.used_hz:.2g} Hz",
        showarrow=False,
        xanchor="left",
        yanchor="bottom",
        xshift=6,
        font={"size": 12, "color": SOFT},
    )
    figure.update_xaxes(type="log", title_text="Frequency [Hz]", dtick=1)
    figure.update_yaxes(title_text="Density below its maximum [dB]", range=[-60, 3])
    return Plot("spectrum", figure)


def excitation_plot(coverage: Coverage) -> Plot | None:
    """Smallest singular value of the input Hankel matrix against the number of lags."""
    if len(coverage.singular) < 2:
        return None
    lags = list(coverage.singular)
    figure = go.Figure(
        go.Scatter(
            x=lags,
            y=[max(value, 1e-9) for value in coverage.singular.values()],
            mode="lines+markers",
            line={"color": BLUE, "width": 2.2},
            marker={"size": 7},
            hovertemplate="%{x} lags: %{y:.3~g}<extra></extra>",
        )
    )
    figure.add_hline(y=1.0, line={"color": SOFT, "width": 1, "dash": "dot"})
    styled(figure, 320, showlegend=False)
    figure.add_annotation(
        x=max(lags), y=0.0, text="white noise", showarrow=False, xanchor="right", yanchor="bottom",
        font={"size": 12, "color": SOFT},
    )  # fmt: skip
    lowest = max(min(coverage.singular.values()), 1e-9)
    figure.update_xaxes(title_text="Lags [samples]", rangemode="tozero")
    figure.update_yaxes(type="log", title_text="Smallest singular value", dtick=1, exponentformat="power")
    figure.update_yaxes(range=[np.floor(np.log10(lowest)) - 0.1, 0.4])
    return Plot("excitation", figure)


def occupancy_plot(occupancy: Occupancy | None) -> Plot | None:
    """Time in each cell of the strokes: a map of the last two for each cell of the first."""
    if occupancy is None:
        return None
    samples = occupancy.samples
    slices = samples.reshape((-1,) + (1,) * max(0, 2 - samples.ndim) + samples.shape[-2:]) if samples.ndim > 1 else None
    maps = [samples.reshape(1, -1)] if slices is None else list(slices.reshape(-1, *samples.shape[-2:]))
    share = [100.0 * part / max(samples.sum(), 1) for part in maps]
    top = max(float(part.max()) for part in share)
    low, high = occupancy.span[0]
    edges = np.linspace(low, high, samples.shape[0] + 1)
    titles = [f"{a:.2f} to {b:.2f} m" for a, b in itertools.pairwise(np.round(edges, 2) + 0.0)]
    columns = min(len(maps), 6)
    figure = make_subplots(
        rows=1,
        cols=columns,
        shared_yaxes=True,
        horizontal_spacing=0.012,
        subplot_titles=titles if len(maps) > 1 else None,
    )
    for i, part in enumerate(share):
        rows, across = (None, 0) if part.shape[0] == 1 else (_centres(occupancy, -2), -1)
        figure.add_heatmap(
            x=_centres(occupancy, across),
            y=rows,
            z=_inked(part, top),
            customdata=part,
            coloraxis="coloraxis",
            xgap=1,
            ygap=1,
            hovertemplate="%{customdata:.2f} % of the time<extra></extra>",
            row=1,
            col=i + 1,
        )
    styled(figure, 310, coloraxis=_colours(top, "% of the time"))
    figure.update_layout(margin={"t": 48, "r": 80})
    figure.update_annotations(font={"size": 12, "color": SOFT})
    if len(maps) > 1:
        figure.layout.annotations[0].text = f"{_short_name(occupancy.names[0])}<br>{titles[0]}"
    axis = _short_name(occupancy.names[-1])
    for i in range(columns):
        figure.update_xaxes(title_text=f"{axis} [m]" if i == 0 or columns == 1 else "", nticks=4, row=1, col=i + 1)
    if samples.ndim > 1:
        figure.update_yaxes(title_text=f"{_short_name(occupancy.names[-2])} [m]", row=1, col=1)
    figure.update_yaxes(showgrid=False)
    return Plot("occupancy", figure)


def joint_plot(coverage: Coverage, group: str) -> Plot | None:
    """Joint histograms of one kind side by side, in shares of the samples on a logarithmic scale."""
    joints = [joint for joint in coverage.joints if joint.group == group][:6]
    if not joints:
        return None
    name = GROUPS[group]
    columns = min(len(joints), 3)
    rows = -(-len(joints) // columns)
    figure = make_subplots(
        rows=rows,
        cols=columns,
        horizontal_spacing=0.085,
        vertical_spacing=0.3 / rows,
        subplot_titles=[_title(joint) for joint in joints],
    )
    shares = [100.0 * joint.counts.T / max(joint.counts.sum(), 1) for joint in joints]
    top = max(float(part.max()) for part in shares)
    for i, (joint, share) in enumerate(zip(joints, shares, strict=True)):
        panel = {"row": i // columns + 1, "col": i % columns + 1}
        figure.add_heatmap(
            x=_middles(joint.x_range, share.shape[1]),
            y=_middles(joint.y_range, share.shape[0]),
            z=_inked(share, top),
            customdata=share,
            coloraxis="coloraxis",
            hovertemplate="%{x:.4~g}, %{y:.4~g}: %{customdata:.3f} %<extra></extra>",
            **panel,
        )
        figure.update_xaxes(title_text=with_unit(_clipped(joint.x), joint.x_unit), **panel)
        figure.update_yaxes(title_text=with_unit(_clipped(joint.y), joint.y_unit), title_standoff=2, **panel)
    styled(figure, 60 + 270 * rows, coloraxis=_colours(top, "% of the samples"))
    figure.update_layout(margin={"t": 34, "r": 80})
    figure.update_annotations(font={"size": 12, "color": SOFT})
    figure.update_yaxes(showgrid=False)
    return Plot(name, figure)


def _inked(share: NDArray[np.float64], top: float) -> list[list[float | None]]:
    """Decades above a ten-thousandth of the fullest cell; None, left white, where nothing was."""
    # Four decades: below it a cell is as good as empty.
    floor = top * 1e-4
    level = np.log10(np.maximum(share, floor) / max(floor, 1e-30))
    return [[None if s <= 0 else round(float(v), 3) for s, v in zip(*row, strict=True)] for row in zip(share, level)]


def _colours(top: float, title: str) -> dict[str, object]:
    ticks = [0, 1, 2, 3, 4]
    return {
        "colorscale": SCALE,
        "cmin": 0,
        "cmax": 4,
        "colorbar": {
            "title": {"text": title.replace(" of", "<br>of"), "font": {"size": 12, "color": SOFT}},
            "tickvals": ticks,
            "ticktext": [f"{top * 10.0 ** (tick - 4):.2g}" for tick in ticks],
            "tickfont": {"size": 11, "color": INK},
            "thickness": 10,
            "outlinecolor": RULE,
            "len": 1.0,
        },
    }


def _title(joint: JointHistogram) -> str:
    return f"correlation {joint.correlation:.2f}, {joint.information:.2f} nat".replace("-", "−")


def _clipped(name: str) -> str:
    return name if len(name) <= 18 else name[:17] + "…"


def _short_name(name: str) -> str:
    return html.escape(_clipped(name))


def _centres(occupancy: Occupancy, axis: int) -> list[float]:
    low, high = occupancy.span[axis]
    return _middles((low, high), occupancy.samples.shape[axis])


def _middles(ends: tuple[float, float], count: int) -> list[float]:
    edges = np.linspace(*ends, count + 1)
    return [float(f"{value:.5g}") for value in 0.5 * (edges[1:] + edges[:-1])]
