"""Subspace identification: a linear state-space model whose order, matrices and filter come from projections.

    x(t+1) = A x(t) + B [u(t); 1] + K e(t),   y(t) = C x(t) + e(t)

The column space of the observability matrix is estimated from future outputs without the effect of future commands,
    projected on the past: PO-MOESP, with past commands and outputs as instruments (Verhaegen 1994; Van Overschee and De
    Moor 1996, ch. 2 to 4). The output for the command of sample t is the machine at t + 1, so there is no direct
    feedthrough.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.errors import DataError
from edp.ir import Builder
from edp.ir.layers import BinaryOperation, Clip, Dense
from edp.ir.memory import Feed, Feedback
from edp.networks.twin.base import PREFIX, TWINS, Twin, TwinState, even_starts, list_solved_columns
from edp.networks.twin.scales import Array, TwinScales
from edp.networks.twin.windows import MeasuredWindows
from edp.settings.bounds import check_bounds, check_count, integer

Doubles = NDArray[np.float64]
MAX_ORDER, MAX_ROWS_BACK = 200, 100
MAX_WINDOWS = 40_000
"""Maximum number of windows, evenly selected from long logs. Their factorisation takes seconds, and neighbouring
windows are nearly equal."""
CHUNK = 4096
"""Number of windows factorised at a time, which bounds the memory."""
SLOWEST = 0.999
"""Maximum modulus of a pole, a time constant of 10 s at 100 Hz. Slower poles describe drift, which the integrated
strokes already contain."""
FARTHEST = 1e4
"""Bound of a model state. States have a magnitude of about 1, and the bound keeps outputs finite for all commands."""
STRETCHES, STRETCH_TICKS = 128, 150
"""Number of segments from which B is computed, each with its own initial state, and their length in samples."""
JUDGED_S, JUDGED_EACH = 10.0, 4
"""Length (s) of the free-run simulations that select the order, and number of simulations per recording."""
KEPT_BACK = 5
"""Interval of the recordings that are held out to select the order: every fifth recording."""
SMALL = 1e-9
"""Minimum singular value of a direction, as a fraction of the largest one. Smaller ones are rounding errors."""
MIN_SHARE = 1e-4
"""Minimum singular value of a state, as a fraction of the largest one. Smaller ones are noise, which filters would
amplify."""
MIN_NOISE = 1e-2
"""Minimum sensor noise, in standard deviations. On exact data a filter would follow each sample instead of the model.
"""


@TWINS.register("n4sid")
@dataclass(frozen=True, kw_only=True)
class N4sid:
    """Subspace identification of velocities and pressures with integrated strokes: a baseline of every twin.

    The selected order has the smallest free-run error on a held-out fifth of the training recordings; a single order
    needs no selection. Poles outside the unit circle are reflected into it, and those slower than a modulus of 0.999
    are shrunk to it, so the model is stable. B is solved for by least squares on simulated segments, K from the
    residual covariance by a Riccati equation.

    Attributes:
        orders: candidate numbers of states. Orders above the rank of the output rows are reduced to this rank.
        horizon: rows of past and of future, in ticks.
        prefix_ticks: measured ticks before a free run.

    Raises:
        ConfigError: a value out of range, or no order.
    """

    orders: tuple[int, ...] = (4, 8, 16, 24, 40)
    horizon: int = 20
    prefix_ticks: int = 30

    def __post_init__(self) -> None:
        order, rows = integer(1, MAX_ORDER), integer(2, MAX_ROWS_BACK)
        check_bounds("n4sid", self, orders=order, horizon=rows, prefix_ticks=PREFIX)
        check_count("n4sid", "orders", self.orders, 100, least=1)

    def start(self, channels: TwinChannels, scales: TwinScales, train: Sequence[Series], seed: int) -> Twin:
        """Fit by projections; no random values are used.

        Raises:
            DataError: recordings that are too short for `horizon`.
        """
        most = len(list_solved_columns(channels)) * (self.horizon - 1)
        orders = sorted({min(order, most) for order in self.orders})
        chosen = orders[0] if len(orders) == 1 else self._choose_order(channels, scales, train, orders)
        solution = _Projections.from_segments(_scale_series(channels, scales, train), self.horizon)
        return self._twin(channels, scales, solution, chosen)

    def _choose_order(
        self, channels: TwinChannels, scales: TwinScales, train: Sequence[Series], orders: Sequence[int]
    ) -> int:
        fitted, judged = _divide(train, self.prefix_ticks + 2 * self.horizon + 2)
        solution = _Projections.from_segments(_scale_series(channels, scales, fitted), self.horizon)
        return min(orders, key=lambda order: _free_error(self._twin(channels, scales, solution, order), judged))

    def _twin(self, channels: TwinChannels, scales: TwinScales, solution: _Projections, order: int) -> Twin:
        shapes, matrices = self.shapes(channels), solution.model(order)
        arrays = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
        for name, matrix in matrices.items():
            arrays[name][: len(matrix), : matrix.shape[1]] = matrix
        arrays["order"][0] = len(matrices["a"])
        return self.build(channels, scales, arrays)

    def shapes(self, channels: TwinChannels) -> dict[str, tuple[int, ...]]:
        """Order, A, B, C and K, with room for the largest order."""
        most, solved = max(self.orders), len(list_solved_columns(channels))
        sizes = {"a": (most, most), "b": (most, len(channels.commands) + 1), "c": (solved, most), "k": (most, solved)}
        return {"order": (1,), **sizes}

    def build(self, channels: TwinChannels, scales: TwinScales, arrays: Mapping[str, Array]) -> Twin:
        """Build the model with these parameters."""
        order = int(arrays["order"][0])
        if not 1 <= order <= max(self.orders):
            raise ValueError(f"its order is {order}; 1 to {max(self.orders)} must hold")
        return N4sidTwin(channels, scales, self.prefix_ticks, {name: arrays[name] for name in self.shapes(channels)})


class N4sidTwin(Twin):
    """State: ``answer`` (outputs) in SI units, and ``states`` of the model ``(batch, order)``.

    A measured port corrects the states by the Kalman gain. A free port reads its own last output, which equals the
    model's output except for bounds, so it does not correct the states.
    """

    def __init__(
        self, channels: TwinChannels, scales: TwinScales, prefix_ticks: int, numbers: Mapping[str, Array]
    ) -> None:
        super().__init__(channels, scales, prefix_ticks)
        self.numbers, self.order = dict(numbers), int(numbers["order"][0])
        n, doubles = self.order, {name: values.astype(np.float64) for name, values in numbers.items()}
        self.a, self.b = doubles["a"][:n, :n], doubles["b"][:n]
        self.c, self.k = doubles["c"][:, :n], doubles["k"][:n]
        solved = list_solved_columns(channels)
        self._solved = solved
        self._offset, self._width = scales.answer_offset[solved], scales.answer_width[solved]

    def initial_state(self, command: Array, measured: Array) -> TwinState:
        # At the means of the training data, as exported forms start; the prefix moves it.
        return {"answer": measured, "states": np.zeros((len(measured), self.order), np.float32)}

    def _commands(self, commands: Array) -> Doubles:
        return _append_ones((commands - self.scales.command_offset) / self.scales.command_width)

    def _read(self, answers: Array) -> Doubles:
        return np.asarray((answers[..., self._solved] - self._offset) / self._width, dtype=np.float64)

    def _run(self, commands: Array, measured: Array, state: TwinState) -> tuple[Array, TwinState]:
        count = len(self.channels.velocities)
        answers, answer, states = np.empty_like(measured), state["answer"], state["states"]
        for t in range(commands.shape[1]):
            fed = np.where(np.isnan(measured[:, t]), answer, measured[:, t])
            wide = states.astype(np.float64)
            surprise = self._read(fed) - wide @ self.c.T
            wide = wide @ self.a.T + self._commands(commands[:, t]) @ self.b.T + surprise @ self.k.T
            states = np.clip(wide, -FARTHEST, FARTHEST).astype(np.float32)
            solved = (states.astype(np.float64) @ self.c.T).astype(np.float32) * self._width + self._offset
            answers[:, t] = answer = self.bounded(fed, solved[:, :count], solved[:, count:])
        return answers, {"answer": answer, "states": states}

    def lower(self, build: Builder, commands: str, fed: str) -> str:
        last = build.add(Feedback, "states_before", size=self.order)
        read = build.pick("read", fed, self._solved)
        limit, inputs = np.full(self.order, FARTHEST), np.concatenate([self.b[:, :-1], self.k], axis=1)
        carried_on = build.add(Dense, "kept", last, weight=self.a - self.k @ self.c, bias=self.b[:, -1])
        rows = build.join("rows", commands, read)
        driven = build.add(Dense, "driven", rows, weight=inputs, bias=np.zeros(self.order))
        moved = build.combine("moved", BinaryOperation.ADD, carried_on, driven)
        states = build.add(Clip, "states", moved, low=-limit, high=limit)
        build.add(Feed, "feed_states", states, into=last)
        return build.add(Dense, "proposed", states, weight=self.c, bias=np.zeros(len(self._solved)))

    def arrays(self) -> dict[str, Array]:
        return self.scales.arrays() | self.numbers


Pair = tuple[Doubles, Doubles]
"""Commands followed by a one, and computed outputs of a segment, both scaled: ``(tick, command + 1)``, ``(tick,
output)``."""


def _append_ones(commands: Array) -> Doubles:
    """Return the scaled commands ``(..., command)`` and a column of ones: the mean of a velocity is not zero."""
    wide = np.ones((*commands.shape[:-1], commands.shape[-1] + 1))
    wide[..., :-1] = commands
    return wide


@dataclass(frozen=True, eq=False)
class _Projections:
    """Data projections from which a model of any order is computed.

    Attributes:
        horizon: rows of past and of future.
        pairs: the segments.
        left: left singular vectors of the future outputs' projection on the past, without the effect of future
            commands, ``(horizon * output, rank)``.
        sizes: their singular values.
        by_past: future outputs by past commands and outputs ``(horizon * output, horizon * (command + output))``.
    """

    horizon: int
    pairs: tuple[Pair, ...]
    left: Doubles
    sizes: Doubles
    by_past: Doubles

    @staticmethod
    def from_segments(pairs: Sequence[Pair], horizon: int) -> _Projections:
        """Compute one QR factorisation of all windows, stacked over the segments.

        Raises:
            DataError: fewer windows than one has numbers.
        """
        commands, answers = pairs[0][0].shape[1], pairs[0][1].shape[1]
        future, past, outputs = horizon * commands, horizon * (commands + answers), horizon * answers
        triangle = np.zeros((0, future + past + outputs))
        windows = 0
        for u, y in _windows(pairs, horizon):
            count = len(u)
            windows += count
            parts = (u[:, horizon:], u[:, :horizon], y[:, :horizon], y[:, horizon:])
            rows = np.concatenate([part.reshape(count, -1) for part in parts], axis=1)
            triangle = np.asarray(np.linalg.qr(np.concatenate([triangle, rows]), mode="r"))
        if windows < triangle.shape[1]:
            raise DataError(
                f"n4sid: {windows} windows of {2 * horizon} ticks came; {triangle.shape[1]} at least must hold: give "
                "longer recordings, or set a smaller twin.horizon"
            )
        # Windows repeat the constant and, where a lever is held, its command: dependent columns leave directions in the
        # triangle that are rounding errors only, so each block is reduced to the directions above `SMALL`.
        without_future = _project_out(triangle[:, future:], _directions(triangle[:, :future]))
        own, across = without_future[:, :past], without_future[:, past:]
        left, sizes, _ = np.linalg.svd((_directions(own).T @ across).T, full_matrices=False)
        by_past = np.asarray(np.linalg.lstsq(own, across, rcond=SMALL)[0].T, dtype=np.float64)
        return _Projections(horizon, tuple(pairs), left, sizes, by_past)

    def model(self, order: int) -> dict[str, Doubles]:
        """Return A, B, C and K of an order, limited to the highest order above rounding errors."""
        order = min(order, int((self.sizes > MIN_SHARE * self.sizes[0]).sum()))
        answers = self.pairs[0][1].shape[1]
        root = np.sqrt(self.sizes[:order] / self.sizes[0])
        seen = self.left[:, :order] * root
        to_states = (self.left[:, :order] / root).T @ self.by_past
        c = seen[:answers]
        a = _stable(np.linalg.lstsq(seen[:-answers], seen[answers:], rcond=SMALL)[0])
        b = _inputs_of(self.pairs, a, c)
        now, later, u, y = _states(self.pairs, self.horizon, to_states)
        return {"a": a, "b": b, "c": c, "k": _gain(a, c, later - now @ a.T - u @ b.T, y - now @ c.T)}


def _directions(columns: Doubles) -> Doubles:
    """Return an orthonormal basis of the column space, without directions below `SMALL` of the largest one."""
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left[:, sizes > SMALL * sizes[0]])


def _project_out(columns: Doubles, directions: Doubles) -> Doubles:
    return columns - directions @ (directions.T @ columns)


def _windows(pairs: Sequence[Pair], horizon: int) -> Iterator[Pair]:
    """Return the windows of past and future ``(window, 2 horizon, channel)``, in chunks."""
    length = 2 * horizon
    usable = [pair for pair in pairs if len(pair[0]) >= length]
    total = sum(len(u) - length + 1 for u, _ in usable)
    every = max(1, total // MAX_WINDOWS)
    for u, y in usable:
        views = [np.moveaxis(sliding_window_view(part, length, axis=0)[::every], 2, 1) for part in (u, y)]
        for first in range(0, len(views[0]), CHUNK):
            yield views[0][first : first + CHUNK], views[1][first : first + CHUNK]


def _states(pairs: Sequence[Pair], horizon: int, to_states: Doubles) -> tuple[Doubles, Doubles, Doubles, Doubles]:
    """Return estimated states in the middle of each window and one sample later, with command and output."""
    columns: list[tuple[Doubles, ...]] = []
    for u, y in _windows(pairs, horizon):
        pasts = [
            np.concatenate([part[:, at : at + horizon].reshape(len(u), -1) for part in (u, y)], axis=1) for at in (0, 1)
        ]
        columns.append((pasts[0] @ to_states.T, pasts[1] @ to_states.T, u[:, horizon], y[:, horizon]))
    now, later, command, output = (np.concatenate(column) for column in zip(*columns, strict=True))
    return now, later, command, output


def _stable(a: Doubles) -> Doubles:
    """Return the poles outside the unit circle reflected, slow ones shrunk to `SLOWEST`."""
    poles, vectors = np.linalg.eig(a)
    modulus = np.abs(poles)
    inside = np.minimum(np.where(modulus > 1.0, 1.0 / np.maximum(modulus, SMALL), modulus), SLOWEST)
    if (inside == modulus).all():
        return a
    moved = poles * inside / np.maximum(modulus, SMALL)
    return np.real(vectors @ np.diag(moved) @ np.linalg.inv(vectors))


def _inputs_of(pairs: Sequence[Pair], a: Doubles, c: Doubles) -> Doubles:
    """Return B by least squares. Outputs are linear in B and in the initial state, which is eliminated."""
    order, commands, answers = len(a), pairs[0][0].shape[1], len(c)
    length = min(STRETCH_TICKS, max(len(u) for u, _ in pairs))
    starts = [(u, y, first) for u, y in pairs for first in range(0, len(u) - length + 1, length)]
    chosen = [starts[i] for i in np.unique(np.linspace(0, len(starts) - 1, STRETCHES).astype(np.int64))]
    powers = np.empty((length, answers, order))
    powers[0] = c
    for t in range(1, length):
        powers[t] = powers[t - 1] @ a
    own, own_state = np.linalg.qr(powers.reshape(-1, order))[0], np.arange(order)
    normal, right = np.zeros((order * commands,) * 2), np.zeros(order * commands)
    for u, y, first in chosen:
        driven, rows = np.zeros((order, order * commands)), np.empty((length, answers, order * commands))
        for t in range(length):
            rows[t] = c @ driven
            driven = a @ driven
            # Add the Kronecker product of a unit matrix and the command, one copy of the command per state.
            driven.reshape(order, order, commands)[own_state, own_state] += u[first + t]
        flat, goal = rows.reshape(length * answers, -1), y[first : first + length].reshape(-1)
        flat = flat - own @ (own.T @ flat)
        normal += flat.T @ flat
        right += flat.T @ (goal - own @ (own.T @ goal))
    # A command that never moved leaves its column at zero.
    normal += SMALL * max(float(np.trace(normal)) / len(normal), SMALL) * np.eye(len(normal))
    return np.asarray(np.linalg.solve(normal, right).reshape(order, commands))


def _gain(a: Doubles, c: Doubles, process: Doubles, output: Doubles) -> Doubles:
    """Return the steady Kalman gain for the residual noise of states ``(row, state)`` and outputs ``(row, output)``."""
    # Here, since every command with a network imports this module, and scipy.linalg takes time.
    from scipy.linalg import solve_discrete_are

    rows = len(process)
    q, r, s = process.T @ process / rows, output.T @ output / rows, process.T @ output / rows
    # Add a minimum noise, because a Kalman filter without noise is undefined for exact data.
    q += SMALL * np.eye(len(q))
    r += MIN_NOISE**2 * np.eye(len(r))
    p = solve_discrete_are(a.T, c.T, q, r, s=s)
    return np.asarray(np.linalg.solve(c @ p @ c.T + r, (a @ p @ c.T + s).T).T)


def _scale_series(channels: TwinChannels, scales: TwinScales, series: Sequence[Series]) -> list[Pair]:
    solved = list_solved_columns(channels)
    offset, width = scales.answer_offset[solved], scales.answer_width[solved]
    return [
        (
            _append_ones((part.inputs - scales.command_offset) / scales.command_width),
            ((part.targets[:, solved] - offset) / width).astype(np.float64),
        )
        for part in series
    ]


def _divide(train: Sequence[Series], least: int) -> tuple[list[Series], list[Series]]:
    """Hold out every fifth recording; for a single recording its last fifth."""
    if len(train) >= KEPT_BACK:
        judged = [part for i, part in enumerate(train) if i % KEPT_BACK == KEPT_BACK - 1 and part.samples >= least]
        if judged:
            return [part for i, part in enumerate(train) if i % KEPT_BACK != KEPT_BACK - 1], judged
    longest = max(train, key=lambda part: part.samples)
    cut = min(longest.samples - longest.samples // KEPT_BACK, max(longest.samples - least, 1))
    first, last = (
        Series(longest.name, longest.inputs[rows], longest.targets[rows]) for rows in (slice(cut), slice(cut, None))
    )
    return [*(part for part in train if part is not longest), first], [last]


def _free_error(twin: Twin, judged: Sequence[Series]) -> float:
    """Return the mean absolute free-run error, each output scaled by its standard deviation."""
    ticks = min(round(JUDGED_S * twin.channels.rate_hz), max(part.samples for part in judged) - twin.prefix_ticks - 1)
    length, prefix = twin.prefix_ticks + ticks, twin.prefix_ticks
    runs = MeasuredWindows.read(even_starts(twin, judged, length + 1, JUDGED_EACH), length)
    state = twin.reset(runs.commands[:, :prefix], runs.outputs[:, :prefix])
    answers, _ = twin.rollout(runs.commands[:, prefix:], state)
    error = np.abs(answers - runs.outputs[:, prefix + 1 :]) / twin.scales.answer_width
    return float(error[..., list_solved_columns(twin.channels)].mean())
