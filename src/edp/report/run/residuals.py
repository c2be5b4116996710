"""Residuals of the network: fit by output, and predictable parts that remain in the errors."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.report.common.chart import BLUE, Chart, ChartAxis, Control, DataSeries, GuideLine, Mark, Panel
from edp.report.run.facts import NETWORK, TRUTH, Facts, horizon_text, score
from edp.report.run.figures import aligned, headline_first
from edp.table import Column, Table
from edp.wording import number

MIN_LAGS, LAGS_PER_HORIZON, MAX_LAGS = 40, 3, 400
"""Number of lags of the correlogram: minimum, per horizon sample, maximum. It shows periodicity beyond the horizon."""
WHITE = 2.576
"""Half-width of the 99 % interval of white-noise correlations, in standard errors."""


def fit_table(facts: Facts) -> Table | None:
    """Fit of the network by output and horizon; None where its scores hold no R².

    ``fit = 100 (1 - sqrt(1 - R²))`` %, which is 100 % less the root-mean-square error over the deviation of the truth:
    the figure that system identification calls fit (Ljung, System Identification, 1999).
    """
    model = facts.models.get(NETWORK)
    horizons = sorted(facts.horizons)
    if model is None or not facts.targets:
        return None
    rows, any_r2 = [], False
    for target in facts.targets:
        cells = []
        for k in horizons:
            r2 = score(model, k, "r2", target.name)
            r2 = score(model, k, "r2") if r2 is None and len(facts.targets) == 1 else r2
            any_r2 = any_r2 or r2 is not None
            cells.append(number(None if r2 is None else 100.0 * (1.0 - math.sqrt(max(1.0 - r2, 0.0))), 1))
        rows.append((target.description, *cells))
    if not any_r2:
        return None
    columns = (Column("Output"), *(Column(f"{horizon_text(facts, k)} ahead", "%") for k in horizons))
    return Table("Fit of the network by output", columns, tuple(rows))


def correlations(facts: Facts, horizon: int, output: int) -> tuple[NDArray[np.float64], int]:
    """Return the autocorrelation of the network's residuals at lags 1, 2, ... and the number of residuals.

    Stretches with gaps are left out; recordings are not joined, so that no lag reaches from one into another.
    """
    column, pieces = facts.horizons.index(horizon), []
    for parts in facts.predictions.values():
        if NETWORK not in parts:
            continue
        error = aligned(parts[NETWORK][:, column, output], horizon) - parts[TRUTH][:, output]
        finite = np.isfinite(error)
        first = int(np.argmax(finite)) if finite.any() else len(error)
        piece = error[first:].astype(np.float64)
        if len(piece) and np.isfinite(piece).all():
            pieces.append(piece)
    count = sum(map(len, pieces))
    lags = min(max(MIN_LAGS, LAGS_PER_HORIZON * horizon), MAX_LAGS, count // 4)
    if not pieces or lags < 2:
        return np.empty(0), count
    mean = float(np.concatenate(pieces).mean())
    power = sum(float(np.square(piece - mean).sum()) for piece in pieces)
    if power <= 0.0:
        return np.empty(0), count
    sums = np.zeros(lags)
    for piece in pieces:
        rest = piece - mean
        sums += [float(rest[lag:] @ rest[: len(rest) - lag]) if lag < len(rest) else 0.0 for lag in range(1, lags + 1)]
    return sums / power, count


def correlogram(facts: Facts) -> Chart | None:
    """Return the autocorrelation of the residuals, one panel per output, with bounds of white noise and the horizon."""
    horizons = headline_first(facts)
    columns = min(len(facts.targets), 3)
    marks: list[list[Mark]] = [[] for _ in facts.targets]
    shown: list[int] = []
    for horizon in horizons:
        for output in range(len(facts.targets)):
            values, count = correlations(facts, horizon, output)
            if not len(values):
                continue
            shown += [] if horizon in shown else [horizon]
            when, lags = {"horizon": str(horizon)}, np.arange(1, len(values) + 1)
            bound, ends = WHITE / math.sqrt(count), [1, len(values)]
            for sign in (1.0, -1.0):
                marks[output].append(DataSeries(
                    x=ends, y=[sign * bound] * 2, name="99 % of white noise", colour="#8b929a", width=1.2, dash="dash",
                    when=when, hover=None,
                ))  # fmt: skip
            marks[output].append(DataSeries(
                x=[horizon, horizon], y=[min(0.0, float(values.min())), 1.0], name="horizon", colour="#c9892f",
                width=1.2, dash="dot", when=when, hover=None,
            ))  # fmt: skip
            marks[output].append(DataSeries(
                x=lags.tolist(), y=np.round(values, 4).tolist(), name="Residuals of the network", colour=BLUE,
                width=1.8, when=when, hover="lag {x}: {y:.3f}", remark="",
            ))  # fmt: skip
    if not shown:
        return None
    panels = []
    for position, (target, row) in enumerate(zip(facts.targets, marks, strict=True)):
        up = ChartAxis("" if position % columns else "Autocorrelation", from_zero=True)
        panels.append(
            Panel((*row, GuideLine(y=0.0)), ChartAxis("Lag [samples]", from_zero=True), up, target.description)
        )
    texts = tuple((str(k), f"{horizon_text(facts, k)} ahead") for k in shown)
    height = 60 + 240 * -(-len(panels) // columns)
    return Chart(
        "whiteness", tuple(panels), columns=columns, choices=(Control("horizon", "Horizon", texts),), height=height
    )
