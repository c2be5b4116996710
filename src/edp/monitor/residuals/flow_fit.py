"""Identifies balances of flow on healthy sessions: dead times, frequencies and play of spools, then curves by lines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, nnls

from edp.data.roles import Axis, roles_of_channels
from edp.monitor.residuals.base import FitMaterial
from edp.monitor.residuals.flow_curves import (
    BACK,
    KNOTS,
    Array,
    ChamberPlaces,
    Singles,
    SpoolModel,
    doubts_of,
    hats,
    lines_of,
    paths_of,
    slopes_of,
    stage_of,
)
from edp.signals import Kind

Curves = tuple[Singles, Singles, Singles, Singles]
"""Values and slopes of the opening curves, linear terms and uncertainty terms of a chamber."""
Fitted = tuple[ChamberPlaces, Singles, Singles, Singles, Singles]
START = (0.045, 7.0, 0.01)
"""Initial values of the search: dead time in s, natural frequency in Hz and backlash of a typical electrohydraulic
valve.
"""
SECOND_LATER = 0.015
"""Additional dead time of the second pump's spool in the initial values, s."""
LEAST, MOST = (0.0, 1.0, 0.0), (0.4, 40.0, 0.2)
"""Lower and upper bounds of the search. Frequencies are also limited to a third of the sample rate."""
SEARCHED_TICKS, SEARCHED_ROWS = 120_000, 16_000
"""Maximum numbers of samples and of compared rows in the search: evenly spaced rows of twenty minutes at 100 Hz."""
RIDGE = 1e-6
GROSS = 8.0
"""Residual, relative to the median size, above which a sample is left out of the second round. At end stops the flow
model is invalid.
"""
CUSHION = 0.06
"""Length of an end-stop cushion as a fraction of the observed stroke."""
OIL = "OilTemperature"
COVERED = (0.01, 0.99)
"""Quantiles that define the temperature range of a session. They exclude single wrong readings."""
BEYOND_K = 5.0
"""Margin in K around the training temperatures within which balances are still valid."""
MIN_TANK = 0.005
"""Quantile of all pressures that estimates the return-line pressure, the lowest pressure of an emptied chamber."""


def fit_chambers(
    material: FitMaterial, rows: int, trials: int, least: float
) -> tuple[tuple[str, ...], SpoolModel, list[Fitted]] | None:
    """Fit the balances of all chambers with sufficient sensors; None without one.

    Returns:
        Names of the inputs that are read, the spools, and places, values, slopes, lines and doubts of each chamber.
    """
    names, axes = material.names, _axes_of(material)
    if not axes:
        return None
    supplies = _supplies_of(material)
    sessions = [session.select(names).astype(np.float32) for session in material.train]
    judging = [session.select(names).astype(np.float32) for session in material.validation] or sessions
    models, places, curves = [], [], []
    for axis in axes:
        own_places = _places(axis, names, supplies, sessions)
        model = _search_spools(axis, names, own_places, sessions, material.rate_hz, trials)
        for spots in own_places:
            fitted = _curves(spots, model, sessions, material.rate_hz, rows)
            if _compute_explained(spots, model, judging, material.rate_hz, fitted) >= least:
                models.append(model)
                places.append(spots)
                curves.append(fitted)
    if not places:
        return None
    return _assemble_chambers(names, models, places, curves)


def _axes_of(material: FitMaterial) -> list[Axis]:
    """Return axes with a command, a velocity and both pressures that are watched."""
    kinds = {channel.name: channel.kind for channel in material.channels}
    return [
        axis
        for axis in roles_of_channels(material.channels).axes
        if axis.command
        and len(axis.pressures) == 2
        and kinds.get(axis.velocity) is Kind.VELOCITY
        and all(kinds.get(name) is Kind.PRESSURE for name in axis.pressures)
    ]


def _supplies_of(material: FitMaterial) -> tuple[int, ...]:
    """Return the indices of pressures without an axis, which are pump pressures."""
    of_axes = {name for axis in roles_of_channels(material.channels).axes for name in axis.pressures}
    pumps = [i for i, c in enumerate(material.channels) if c.kind is Kind.PRESSURE and c.name not in of_axes]
    return tuple(pumps[:4])


def _places(
    axis: Axis, names: Sequence[str], supplies: tuple[int, ...], sessions: Sequence[Singles]
) -> list[ChamberPlaces]:
    """Return both chambers of an axis with the spools of its own model: 0, and 1 for the second pump's."""
    at = {name: i for i, name in enumerate(names)}
    head, rod = (at[name] for name in axis.pressures)
    stroke = at.get(axis.stroke, -1)
    low, high = 0.0, 1.0
    if stroke >= 0:
        low = float(min(rows[:, stroke].min() for rows in sessions))
        high = float(max(rows[:, stroke].max() for rows in sessions))
    pressures = np.concatenate([rows[::7, [head, rod]].ravel() for rows in sessions])
    tank = max(float(np.quantile(pressures, MIN_TANK)), 0.0) * 1e-6
    spools = (0, 1) if axis.conflux else (0,)
    length = max(CUSHION * (high - low), 1e-6)
    return [
        ChamberPlaces(at[axis.velocity], own, other, stroke, supplies, spools, sign, end, far, length, tank)
        for own, other, sign, end, far in ((head, rod, 1, low, high), (rod, head, -1, high, low))
    ]


def _model(axis: Axis, names: Sequence[str], gains: Sequence[float], numbers: Array, rate_hz: float) -> SpoolModel:
    """Return the spools of an axis by dead time, frequency and play, and dead time and frequency of the second."""
    commands = [axis.command, *([axis.conflux] if axis.conflux else [])]
    timings = [(numbers[0], numbers[1]), (numbers[-2], numbers[-1])][: len(commands)]
    at = {name: i for i, name in enumerate(names)}
    stages = np.stack([np.stack([stage_of(frequency, rate_hz)] * 2) for _, frequency in timings])
    return SpoolModel(
        extend=np.array([at[command[0]] for command in commands], np.int64),
        retract=np.array([at[command[1]] if len(command) > 1 else -1 for command in commands], np.int64),
        gain=np.array(gains, np.float32),
        dead=np.array([dead * rate_hz for dead, _ in timings]),
        stages=stages,
        play=np.full(len(commands), numbers[2], np.float32),
    )


def _search_spools(
    axis: Axis,
    names: Sequence[str],
    places: Sequence[ChamberPlaces],
    sessions: Sequence[Singles],
    rate_hz: float,
    trials: int,
) -> SpoolModel:
    """Return the spool model whose curves explain the velocity best."""
    chosen = _stretch(sessions, axis, names)
    stride = max(1, len(chosen) * len(chosen[0]) // SEARCHED_ROWS)
    at = {name: i for i, name in enumerate(names)}
    gains = [
        1.0 / max(float(max(np.abs(rows[:, [at[n] for n in command]]).max() for rows in chosen)), 1e-30)
        for command in (axis.command, axis.conflux)
        if command
    ]
    low, high = list(LEAST), [MOST[0], min(MOST[1], rate_hz / 3.0), MOST[2]]
    start = [*START]
    if axis.conflux:
        low, high = [*low, *LEAST[:2]], [*high, *high[:2]]
        start += [START[0] + SECOND_LATER, START[1]]
    start = np.clip(start, low, high).tolist()

    def error(numbers: Array) -> float:
        model = _model(axis, names, gains, np.clip(numbers, low, high), rate_hz)
        return sum(_compute_remaining(spots, model, chosen, rate_hz, stride) for spots in places)

    simplex = np.array([start] + [_make_corner(start, i) for i in range(len(start))])
    options = {"maxfev": trials, "initial_simplex": np.clip(simplex, low, high), "xatol": 1e-4, "fatol": 1e-5}
    best = minimize(error, start, method="Nelder-Mead", options=options).x
    return _model(axis, names, gains, np.clip(best, low, high), rate_hz)


def _make_corner(start: Sequence[float], index: int) -> list[float]:
    """Return a corner of the initial simplex: shifts of dead time, frequency or play."""
    moved = list(start)
    moved[index] += (0.015, 1.5, 0.006, 0.015, 1.5)[index]
    return moved


def _stretch(sessions: Sequence[Singles], axis: Axis, names: Sequence[str]) -> list[Singles]:
    """Return some sessions of equal length in which the axis is commanded most."""
    at = [list(names).index(name) for name in axis.command]
    usual = min(len(rows) for rows in sessions)
    count = max(1, min(len(sessions), SEARCHED_TICKS // usual))
    busy = np.argsort([-float(np.abs(rows[:, at]).mean()) for rows in sessions])[:count]
    return [sessions[i][: min(usual, SEARCHED_TICKS)] for i in busy]


Part = tuple[list[tuple[Singles, Singles]], list[Singles], Singles, Singles, Singles]
"""Flow paths as (spool travel, drive) pairs, linear terms, velocity, measured rows, and their rates of change."""


def _terms(
    spots: ChamberPlaces, model: SpoolModel, rows: Singles, rate_hz: float, keep: Callable[[Singles], Singles]
) -> Part:
    """Return the terms of a balance at selected samples of a session, `BACK` samples ago."""
    whole = np.concatenate([np.repeat(rows[:1], model.memory, axis=0), rows])[None]
    spools, _ = model.run(whole, model.start(model.demands(rows[None, 0])))
    end, ticks = whole.shape[1], len(rows)
    pieces = [keep(whole[0, end - ticks - back : end - back]) for back in (BACK, 0, 1, 3, 4)]
    rates = ((pieces[1] - pieces[4]) + (pieces[2] - pieces[3])) * np.float32(rate_hz / 6.0)
    then = pieces[0]
    lines, velocity = lines_of(spots, then, rates), then[:, spots.velocity]
    return paths_of(spots, then, keep(spools[0])), lines, velocity, then, rates


def _columns(part: Part) -> Array:
    """Return the columns of the regression, shape (ticks, paths (knots - 1) + LINES)."""
    paths, lines = part[:2]
    curves = [hats(travel) * np.asarray(drive, np.float64)[:, None] for travel, drive in paths]
    return np.concatenate([*curves, np.stack(lines, axis=1).astype(np.float64)], axis=1)


def _solve_robustly(columns: Array, target: Array) -> Array:
    """Fit by least squares with a small ridge penalty, and again without gross outliers."""
    size = np.sqrt(np.square(columns).mean(axis=0))
    size = np.where(size > 1e-12, size, 1e-12)
    keep: NDArray[np.bool_] = np.ones(len(target), dtype=bool)
    factors = np.zeros(columns.shape[1])
    for _ in range(2):
        scaled, goal = columns[keep] / size, target[keep]
        normal = scaled.T @ scaled + RIDGE * len(goal) * np.eye(len(size))
        factors = np.linalg.solve(normal, scaled.T @ goal) / size
        off = np.abs(target - columns @ factors)
        keep = off <= GROSS * max(float(np.median(off)), 1e-12)
    return factors


def _compute_remaining(
    spots: ChamberPlaces, model: SpoolModel, sessions: Sequence[Singles], rate_hz: float, stride: int
) -> float:
    """Return the mean residual of a balance on its fitting sessions, relative to the mean velocity."""
    parts = [_terms(spots, model, rows, rate_hz, lambda v: v[50::stride]) for rows in sessions]
    columns, target = np.concatenate([_columns(part) for part in parts]), np.concatenate([part[2] for part in parts])
    target = spots.sign * target.astype(np.float64)
    off = np.abs(target - columns @ _solve_robustly(columns, target))
    return float(off.mean() / max(float(np.abs(target).mean()), 1e-12))


def _curves(spots: ChamberPlaces, model: SpoolModel, sessions: Sequence[Singles], rate_hz: float, rows: int) -> Curves:
    """Return the fitted curves of a chamber, over all training sessions."""
    stride = max(1, sum(map(len, sessions)) // rows)
    parts = [_terms(spots, model, session, rate_hz, lambda v: v[50::stride]) for session in sessions]
    target = np.concatenate([part[2] for part in parts]).astype(np.float64) * spots.sign
    columns = np.concatenate([_columns(part) for part in parts])
    then, rates = (np.concatenate([part[index] for part in parts]) for index in (3, 4))
    own = len(KNOTS) - 1
    width, factors, doubts = np.ones(len(target)), np.zeros(0), np.zeros(0)
    # The second time by the widths of the first: what is uncertain counts less.
    for _ in range(2):
        factors = _solve_robustly(columns / width[:, None], target / width)
        flows = columns[:, : spots.paths * own] * factors[: spots.paths * own]
        through = np.abs(flows.reshape(len(flows), spots.paths, own).sum(axis=2)).sum(axis=1).astype(np.float32)
        terms = np.stack(doubts_of(spots, then, rates, through), axis=1).astype(np.float64)
        doubts = _doubts(terms, np.abs(target - columns @ factors))
        width = terms @ doubts
    heights = factors[: spots.paths * own].reshape(spots.paths, own)
    values = np.concatenate([np.zeros((spots.paths, 1)), heights], axis=1)
    lines = factors[spots.paths * own :]
    numbers = (one.astype(np.float32) for one in (values, slopes_of(values), lines, doubts))
    return tuple(numbers)  # type: ignore[return-value]


def fit_oil_range(material: FitMaterial) -> tuple[str, float, float] | None:
    """Return the oil temperature channel and the temperature range of healthy sessions; None without one.

    A channel of the vocabulary's name, or the only temperature there is.
    """
    names = [channel.name for channel in material.channels if channel.kind is Kind.TEMPERATURE]
    chosen = OIL if OIL in names else names[0] if len(names) == 1 else ""
    if not chosen:
        return None
    ends = [np.quantile(s.column(chosen), COVERED) for s in (*material.train, *material.validation)]
    low, high = np.min(ends, axis=0)[0], np.max(ends, axis=0)[1]
    return chosen, float(low) - BEYOND_K, float(high) + BEYOND_K


def _doubts(columns: Array, off: Array) -> Array:
    """Fit the usual deviation of a balance as a non-negative sum of its sources of uncertainty."""
    usual = max(float(np.median(off)), 1e-12)
    size = np.maximum(columns.max(axis=0), 1e-12)
    scaled, _ = nnls(columns / size, off)
    factors: Array = scaled / size
    # A width of nothing in particular: half of the usual one at least.
    factors[0] = max(factors[0], 0.5 * usual)
    return factors


def _compute_explained(
    spots: ChamberPlaces,
    model: SpoolModel,
    sessions: Sequence[Singles],
    rate_hz: float,
    fitted: Curves,
) -> float:
    """Return the fraction of the mean velocity explained by a balance."""
    values, _, lines, _ = fitted
    factors = np.concatenate([values[:, 1:].ravel(), lines]).astype(np.float64)
    off = size = 0.0
    for rows in sessions[:8]:
        part = _terms(spots, model, rows, rate_hz, lambda v: v[50::10])
        target = spots.sign * part[2].astype(np.float64)
        off, size = off + float(np.abs(target - _columns(part) @ factors).mean()), size + float(np.abs(target).mean())
    return 1.0 - off / max(size, 1e-12)


@dataclass
class _Numbered:
    names: list[str]

    def column(self, name: str) -> int:
        if name not in self.names:
            self.names.append(name)
        return self.names.index(name)


def _assemble_chambers(
    names: Sequence[str],
    models: Sequence[SpoolModel],
    places: Sequence[ChamberPlaces],
    curves: Sequence[Curves],
) -> tuple[tuple[str, ...], SpoolModel, list[Fitted]]:
    """Return all chambers with the inputs that they read, and their spools as one model."""
    inputs, own, first = _Numbered([]), list(dict.fromkeys(map(id, models))), {}
    apart = {id(model): model for model in models}
    for key in own:
        first[key] = sum(len(apart[other].gain) for other in own[: own.index(key)])

    def moved(column: int) -> int:
        return inputs.column(names[column]) if column >= 0 else -1

    extend, retract = (
        np.array([moved(int(c)) for key in own for c in getattr(apart[key], side)], np.int64)
        for side in ("extend", "retract")
    )
    joined = {
        name: np.concatenate([getattr(apart[key], name) for key in own]) for name in ("gain", "dead", "stages", "play")
    }
    moved_chambers: list[Fitted] = []
    for spots, model, numbers in zip(places, models, curves, strict=True):
        spools = tuple(first[id(model)] + spool for spool in spots.spools)
        columns = {name: moved(getattr(spots, name)) for name in ("velocity", "own", "other", "stroke")}
        supplies = tuple(moved(column) for column in spots.supplies)
        new = ChamberPlaces(
            **columns, supplies=supplies, spools=spools, sign=spots.sign, end=spots.end, far=spots.far,
            cushion=spots.cushion, tank=spots.tank,
        )  # fmt: skip
        moved_chambers.append((new, *numbers))
    return tuple(inputs.names), SpoolModel(extend, retract, **joined), moved_chambers
