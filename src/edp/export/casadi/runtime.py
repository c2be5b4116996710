"""Network as a CasADi function with explicit states. Needs NumPy and CasADi only.

    network = Network("predictor.json")
    x, u = network.start, inputs of a tick in SI units, in the order of network.inputs
    x, prediction, *bounds = network.step(x, u)

`network.step` is an MX function with derivatives of any order; call it with symbols to build a controller.
"""

from __future__ import annotations

import json
import math
import subprocess
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

LARGEST = 3e38
"""Largest valid input. If an input is larger or NaN, all results are NaN."""
EXTERNAL = "_external"

Held = dict[str, Any]
"""State of a layer by slot: columns, or ring buffers with one column per sample, the oldest first."""


class Network:
    """An exported network.

    Attributes:
        about: content of ``NAME.json``.
        inputs, targets: names, in the order of ``u`` and of the predictions.
        rate_hz: sampling rate in Hz.
        start: the state after a reset, ``(state,)``.
        step: ``(x, u) -> (x_next, prediction[, lower, upper])``, columns; of a prediction horizons are slowest.

    Raises:
        ValueError: the file is of another version or holds a layer that is not known.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.about = json.loads(self.path.read_text())
        if self.about["schema"] != 1:
            raise ValueError(f"{path} has schema {self.about['schema']}, this file reads 1; export the network again")
        with np.load(self.path.with_suffix(".npz")) as archive:
            self._arrays = {name: np.asarray(archive[name], dtype=float) for name in archive.files}
        self.inputs = [channel["name"] for channel in self.about["inputs"]]
        self.targets = [target["name"] for target in self.about["targets"]]
        self.rate_hz = float(self.about["rate_hz"])
        self.start = self._arrays["start"]
        self.step = self._build()

    def order(self, names: Sequence[str]) -> list[int]:
        """Return the position of each input in `names`, the columns of a recording.

        Raises:
            ValueError: one of them is missing.
        """
        missing = [name for name in self.inputs if name not in names]
        if missing:
            raise ValueError(f"inputs {', '.join(missing)} are missing; the network reads {', '.join(self.inputs)}")
        return [list(names).index(name) for name in self.inputs]

    def compile(self, compiler: str = "cc", *flags: str) -> Path:
        """Compile the C code next to the data to a shared library.

        Raises:
            RuntimeError: the compiler is missing or says no, or there is no C: a grey box has none here.
        """
        folder, compiled = self.path.parent, self.path.with_name(f"{self.about['name']}_external.so")
        options = flags or ("-O2", "-ffp-contract=off", "-fvisibility=hidden")
        sources = sorted(str(path) for path in folder.glob("*.c"))
        if not sources:
            raise RuntimeError(f"{folder} holds no C code to compile; use network.step, the symbolic form")
        command = [compiler, "-std=c99", *options, "-shared", "-fPIC", *sources, "-lm", "-o", str(compiled)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError as error:
            raise RuntimeError(f"compiler '{compiler}' does not start ({error}); name another one") from error
        if done.returncode:
            raise RuntimeError(f"'{compiler}' cannot compile {folder}:\n{done.stderr[-2000:]}")
        return compiled

    def external(self, library: str | Path) -> ca.Function:
        """Return the step function of the C library with its Jacobian: faster, in single precision."""
        return ca.external(self.about["name"] + EXTERNAL, str(Path(library).resolve()))

    def horizon(self, steps: int, carry: Any, feed: Any) -> ca.Function:
        """Return the network run on its own predictions: ``(x, first, base) -> y``.

        The inputs of a tick are ``carry * inputs before + feed @ prediction before + base``; those of the first tick
        are ``first``. So velocities that are predicted a tick ahead feed themselves, positions are carried and fed
        with velocity times tick, and commands come from ``base``.

        Args:
            steps: ticks.
            carry: ``(input,)``.
            feed: ``(input, prediction)``.

        Returns:
            ``first`` is ``(input,)``, ``base`` ``(input, steps)`` of which the first column is not read, ``y``
            ``(prediction, steps)``.
        """
        x, u = ca.MX.sym("x", len(self.start)), ca.MX.sym("first", len(self.inputs))
        base = ca.MX.sym("base", len(self.inputs), steps)
        state, now = x, u
        predictions: list[ca.MX] = []
        for tick in range(steps):
            if tick:
                now = ca.DM(np.asarray(carry)) * now + ca.DM(np.asarray(feed)) @ predictions[-1] + base[:, tick]
            state, y = self.step(state, now)[:2]
            predictions.append(y)
        return ca.Function("horizon", [x, u, base], [ca.horzcat(*predictions)], ["x", "first", "base"], ["y"])

    def _build(self) -> ca.Function:
        x, u = ca.MX.sym("x", len(self.start)), ca.MX.sym("u", len(self.inputs))
        values = {"input": ca.if_else(ca.fabs(u) <= LARGEST, u, math.nan)}
        states: dict[str, Held] = {layer["name"]: {} for layer in self.about["layers"]}
        at = 0
        for state in self.about["states"]:
            size = state["rows"] * state["columns"]
            # The layout of a matrix is that of its ticks, one behind the other.
            states[state["layer"]][state["slot"]] = ca.reshape(x[at : at + size], state["columns"], state["rows"])
            at += size
        for layer in self.about["layers"]:
            write = LAYERS.get(layer["kind"])
            if write is None:
                raise ValueError(f"layer '{layer['name']}' is a {layer['kind']}, which is not known here")
            constants = {name: self._arrays[f"{layer['name']}/{name}"] for name in layer["constants"]}
            part = _Part(layer, constants, states, states[layer["name"]])
            values[layer["name"]] = write(part, *(values[name] for name in layer["inputs"]))
        after = [ca.vec(states[state["layer"]][state["slot"]]) for state in self.about["states"]]
        results = {meaning: values[name] for meaning, name in self.about["values"].items()}
        return ca.Function("step", [x, u], [_stack(after), *results.values()], ["x", "u"], ["x_next", *results])


class _Part:
    """Layer under construction: options, constants, and states of this and the other layers."""

    def __init__(
        self, options: Mapping[str, object], w: Mapping[str, np.ndarray], everything: dict[str, Held], own: Held
    ):
        self.options, self.w, self.everything, self.m = options, w, everything, own

    def __getattr__(self, name: str) -> Any:
        return self.options[name]

    def count(self) -> Any:
        """Return the number of earlier samples, an integer without derivative."""
        return ca.floor(self.m["age"] + 0.5)

    def push(self, slot: str, x: Any) -> Any:
        """Append this sample to the window, one column per sample, and remove the oldest sample from the ring."""
        full = ca.horzcat(self.m[slot], x)
        self.m[slot] = full[:, 1:]
        return full


def _stack(parts: Sequence[Any]) -> Any:
    return ca.vertcat(*parts) if parts else ca.MX(0, 1)


def _sigmoid(x: Any) -> Any:
    return 0.5 * (1 + ca.tanh(0.5 * x))


def _softmax(rows: Any) -> Any:
    """Return the softmax of each row."""
    weights = []
    for row in ca.vertsplit(rows):
        raised = ca.exp(row - ca.mmax(row))
        weights.append(raised / ca.sum2(raised))
    return ca.vertcat(*weights)


def _rows(x: Any, rows: int) -> Any:
    """Return a value of several rows as a matrix with one column per row."""
    return ca.reshape(x, x.numel() // rows, rows)


def _split(x: Any, parts: int) -> list[Any]:
    return ca.vertsplit(x, x.shape[0] // parts)


def _keep_nan(x: Any, y: Any) -> Any:
    return ca.if_else(x == x, y, math.nan)


FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "relu": lambda x: _keep_nan(x, ca.if_else(x > 0, x, 0)),
    "sigmoid": _sigmoid,
    "tanh": ca.tanh,
    "gelu": lambda x: 0.5 * x * (1 + ca.erf(x / math.sqrt(2))),
    "softplus": lambda x: _keep_nan(x, ca.if_else(x > 0, x, 0) + ca.log1p(ca.exp(-ca.fabs(x)))),
    "exp": ca.exp,
    "sqrt": ca.sqrt,
    "sine": ca.sin,
    "cosine": ca.cos,
    "log": lambda x: ca.log(ca.fmax(x, 2.0**-126)),
    "positive": lambda x: _keep_nan(x, x > 0),
}


def _glu(p: _Part, x: Any) -> Any:
    value, gate = _split(_rows(x, p.rows), 2)
    return ca.vec(value * _sigmoid(gate))


def _accumulate(p: _Part, x: Any) -> Any:
    rows = ca.horzsplit(_rows(x, p.rows))
    for at in range(1, p.rows):
        rows[at] = rows[at - 1] + rows[at]
    return ca.vertcat(*rows)


def _dense(p: _Part, x: Any) -> Any:
    columns = ca.horzsplit(_rows(x, p.rows)) if p.rows > 1 else [x]
    return ca.vertcat(*(p.w["weight"] @ column + p.w["bias"] for column in columns))


def _grouped_dense(p: _Part, x: Any) -> Any:
    columns = ca.horzsplit(_rows(x, len(p.w["bias"])))
    return ca.vertcat(*(w @ column + b for w, column, b in zip(p.w["weight"], columns, p.w["bias"], strict=True)))


def _trees(p: _Part, x: Any) -> Any:
    outputs, trees, leaves = p.w["leaf"].shape
    feature, threshold, leaf = (p.w[name].reshape(outputs * trees, -1) for name in ("feature", "threshold", "leaf"))
    y, first = ca.MX(ca.DM(leaf)), leaves // 2
    while first:  # from the leaves up each node hands on the number of its side
        here = slice(first - 1, 2 * first - 1)
        read = x[feature[:, here].astype(int).ravel(order="F").tolist()]
        right = ca.reshape(read, outputs * trees, first) > ca.DM(threshold[:, here])
        y, first = ca.if_else(right, y[:, 1::2], y[:, ::2]), first // 2
    return _keep_nan(ca.sum1(x), ca.sum1(ca.reshape(y, trees, outputs)).T)


def _normalise(x: Any, epsilon: float) -> Any:
    count, middle = x.shape[0], x - ca.sum1(x) / x.shape[0]
    return middle / ca.sqrt(ca.sum1(middle * middle) / count + epsilon)


def _norm(p: _Part, x: Any) -> Any:
    columns = ca.horzsplit(_rows(x, p.rows)) if p.rows > 1 else [x]
    return ca.vertcat(*(_normalise(column, p.epsilon) * p.w["gain"] + p.w["shift"] for column in columns))


def _row_attention(p: _Part, *qkv: Any) -> Any:
    q, k, v = (_rows(x, p.rows) for x in qkv)
    return ca.vec(v @ _softmax(q.T @ k / math.sqrt(p.size)).T)


def _difference(p: _Part, x: Any) -> Any:
    change = p.w["factor"] * (x - p.m["before"])
    seen = p.count()
    p.m["before"], p.m["age"] = x, ca.MX(1)
    return change if p.from_zero else change * seen


def _starting(p: _Part, x: Any) -> Any:
    seen = p.count()
    read = seen < p.ticks
    p.m["age"] = ca.fmin(seen + 1, p.ticks)
    return ca.vertcat(read * x + (1 - read) * p.w["mean"], read)


def _convolution(p: _Part, x: Any) -> Any:
    weight = p.w["weight"]
    taps = weight.shape[1]
    full, total = p.push("ring", x) if taps > 1 else x, ca.DM(p.w["bias"])
    for tap in range(taps):
        total = total + weight[:, tap] @ full[:, tap * p.dilation]
    return total


def _cell(p: _Part, gates: Any, squash: Callable[[Any], Any]) -> Any:
    i, f, g, o = _split(gates, 4)
    h, c = p.m["h"], p.m["c"]
    fresh = _sigmoid(f) * c + _sigmoid(i) * ca.tanh(g)
    out = _sigmoid(o) * ca.tanh(squash(fresh))
    if p.share == 1:
        p.m["h"], p.m["c"] = out, fresh
    else:
        p.m["h"], p.m["c"] = h + p.share * (out - h), c + p.share * (fresh - c)
    return p.m["h"]


def _layer_norm_lstm(p: _Part, x: Any) -> Any:
    driven = _normalise(p.w["weight_x"] @ x, p.epsilon) * p.w["gain_x"]
    gates = driven + _normalise(p.w["weight_h"] @ p.m["h"], p.epsilon) * p.w["gain_h"] + p.w["bias"]
    return _cell(p, gates, lambda c: _normalise(c, p.epsilon) * p.w["gain_c"] + p.w["shift_c"])


def _gru(p: _Part, x: Any) -> Any:
    into = _split(p.w["weight_x"] @ x + p.w["bias_x"], 3)
    back = _split(p.w["weight_h"] @ p.m["h"] + p.w["bias_h"], 3)
    r, z = (_sigmoid(a + b) for a, b in zip(into[:2], back[:2], strict=True))
    fresh = ca.tanh(into[2] + r * back[2])
    p.m["h"] = fresh + z * (p.m["h"] - fresh)
    return p.m["h"]


def _min_gru(p: _Part, x: Any) -> Any:
    gate, candidate = _split(x, 2)
    z = _sigmoid(gate)
    p.m["h"] = (1 - z) * p.m["h"] + z * candidate
    return p.m["h"]


def _rotation(p: _Part, x: Any) -> Any:
    a, b = ca.DM(p.w["factor"][:, 0]).T, ca.DM(p.w["factor"][:, 1]).T
    re, im = ca.vertsplit(p.m["h"])
    p.m["h"] = ca.vertcat(a * re - b * im, a * im + b * re) + _rows(x, len(p.w["factor"]))
    return ca.vec(p.m["h"])


def _trailing_mean(p: _Part, x: Any) -> Any:
    seen, full = p.count(), p.push("ring", x) if p.window > 1 else x
    p.m["age"] = ca.fmin(seen + 1, p.window - 1)
    return ca.sum2(full) / (seen + 1)


def _attention_pool(p: _Part, x: Any) -> Any:
    if p.window == 1:
        return x
    scores = p.push("scores", ca.dot(ca.DM(p.w["score"]), x) + float(p.w["bias"][0]))
    return p.push("ring", x) @ _softmax(scores).T


def _window_attention(p: _Part, q: Any, k: Any, v: Any) -> Any:
    seen = p.count()
    p.m["age"] = ca.fmin(seen + 1, p.window - 1)
    if p.window == 1:
        return v
    keys, values = p.push("keys", k), p.push("values", v)
    # Column j of the window was seen if at most window - 1 - j ticks are missing.
    unseen = seen < ca.DM(np.arange(p.window - 1, -1, -1)).T
    heads = [_split(part, p.heads) for part in (q, keys, values)]
    root = math.sqrt(p.size / p.heads)
    attended = [vs @ _softmax(qs.T @ ks / root - 1e30 * unseen).T for qs, ks, vs in zip(*heads, strict=True)]
    return ca.vertcat(*attended)


def _prefix(p: _Part, x: Any) -> Any:
    seen = p.count()
    total = p.m["total"] + x * (seen < p.ticks)
    hidden = ca.tanh(p.w["first_weight"] @ ca.vertcat(total / p.ticks, x) + p.w["first_bias"])
    numbers, at = (p.w["second_weight"] @ hidden + p.w["second_bias"]) * (seen == p.ticks - 1), 0
    for name, slot in p.corrects:
        old = p.everything[name][slot]
        p.everything[name][slot] = old + ca.reshape(numbers[at : at + old.numel()], *old.shape)
        at += old.numel()
    p.m["total"], p.m["age"] = total, ca.fmin(seen + 1, p.ticks)
    return ca.MX(0, 1)


def _feed(p: _Part, x: Any) -> Any:
    p.everything[p.into]["last"] = x
    return ca.MX(0, 1)


LAYERS: dict[str, Callable[..., Any]] = {
    "Gather": lambda p, *parts: _stack(parts)[p.columns],
    "Standardise": lambda p, x: (x - p.w["offset"]) / p.w["scale"],
    "ScaleShift": lambda p, x: x * p.w["gain"] + p.w["shift"],
    "Add": lambda p, a, b: a + b,
    "Subtract": lambda p, a, b: a - b,
    "Multiply": lambda p, a, b: a * b,
    "Divide": lambda p, a, b: a / b,
    "Minimum": lambda p, a, b: _keep_nan(a + b, ca.if_else(a > b, b, a)),
    "Maximum": lambda p, a, b: _keep_nan(a + b, ca.if_else(a < b, b, a)),
    "Clip": lambda p, x: _keep_nan(x, ca.fmax(ca.fmin(x, p.w["high"]), p.w["low"])),
    "Activate": lambda p, x: FUNCTIONS[p.function](x),
    "Glu": _glu,
    "Accumulate": _accumulate,
    "Dense": _dense,
    "GroupedDense": _grouped_dense,
    "TreeSums": _trees,
    "LayerNorm": _norm,
    "RowAttention": _row_attention,
    "Difference": _difference,
    "Starting": _starting,
    "Convolution": _convolution,
    "Lstm": lambda p, x: _cell(p, p.w["weight_x"] @ x + p.w["weight_h"] @ p.m["h"] + p.w["bias"], lambda c: c),
    "LayerNormLstm": _layer_norm_lstm,
    "Gru": _gru,
    "MinGru": _min_gru,
    "Rotation": _rotation,
    "TrailingMean": _trailing_mean,
    "AttentionPool": _attention_pool,
    "WindowAttention": _window_attention,
    "Feedback": lambda p: p.m["last"],
    "Feed": _feed,
    "PrefixCorrection": _prefix,
    "HydraulicTick": lambda p, *x: import_module("edp_hydraulics").write_tick(p, *x),
}
"""Functions of the layers by class name."""
