"""The graph ``window``: W ticks from reset in, the predictions after the last of them out.

Only the rows that the last tick rests on are computed. What is alike at every tick runs over all of them at once; a
recurrence for which ONNX has no operator is written tick by tick.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from edp.errors import ExportError
from edp.export.onnx.memory import STEPS, attend, correct, shape_of
from edp.export.onnx.nodes import DEFAULT_OPSET, Nodes
from edp.export.onnx.plain import PLAIN, activate, combine
from edp.export.onnx.sequence import Sequences
from edp.export.onnx.step import INPUTS, add_results, corrections, plain_name, refuse, spoil
from edp.ir import Graph, Layer, layers, memory
from edp.ir.base import INPUT
from edp.ir.layers import BinaryOperation
from edp.ir.memory import UNSEEN

TRAILING = (memory.TrailingMean, memory.AttentionPool, memory.WindowAttention)
CHANNELS_FIRST = (BinaryOperation.ADD, BinaryOperation.MULTIPLY)
"""Operations that keep the channels-first layout of convolutions if an input has this layout."""


def rows_before(layer: Layer, rows: int, ticks: int) -> int:
    """Return the number of input rows required for the last `rows` rows of a layer, at most `ticks`."""
    if isinstance(layer, memory.Difference):
        # One tick more: the change at the first row needs its predecessor.
        return min(ticks, rows + 1)
    if isinstance(layer, memory.Convolution):
        return int(min(ticks, rows + (layer.weight.shape[1] - 1) * layer.dilation))
    if isinstance(layer, TRAILING):
        return min(ticks, rows + layer.window - 1)
    # A recurrence rests on all ticks since the reset.
    return ticks if type(layer) in STEPS and not isinstance(layer, memory.Starting) else rows


def rows_needed(graph: Graph, ticks: int) -> dict[str, int]:
    """Return the number of rows of each value required for the predictions after the last sample."""
    need = dict.fromkeys((INPUT, *(layer.name for layer in graph.layers)), 0)
    need |= dict.fromkeys(graph.results.values(), 1)
    for layer in reversed(graph.layers):
        # The correction reads the first ticks, wherever the results lie.
        if isinstance(layer, memory.PrefixCorrection):
            before = ticks if layer.ticks < ticks else 0
        else:
            before = rows_before(layer, need[layer.name], ticks) if need[layer.name] else 0
        for name in layer.inputs:
            need[name] = max(need[name], before)
    return need


class Window:
    """Writes the layers of a graph over a window.

    Args:
        nodes: receiver of the nodes.
        graph: the layers.
    """

    def __init__(self, nodes: Nodes, graph: Graph) -> None:
        self.nodes, self.graph, self.ticks = nodes, graph, graph.window
        self.need = rows_needed(graph, self.ticks)
        self.values = Sequences(nodes)
        self.values.give(INPUT, INPUTS, self.ticks, graph.inputs)
        owners = [layer for layer in graph.layers if isinstance(layer, memory.PrefixCorrection)]
        self.corrected = {owner: layer for layer in owners for owner, _ in layer.corrects if layer.ticks < self.ticks}
        self._parts: dict[str, dict[tuple[str, str], str]] = {}

    def add(self, layer: Layer) -> None:
        """Write a layer.

        Raises:
            ExportError: its kind has no form in ONNX.
        """
        rows = self.need[layer.name]
        if not rows or isinstance(layer, memory.PrefixCorrection):
            return
        write = getattr(self, f"_{WINDOWS[type(layer)]}") if type(layer) in WINDOWS else None
        if write is not None:
            write(layer, rows)
        elif (number_by_number := self._find_writer(layer)) and any(
            self.values.in_columns(name, rows) for name in layer.inputs
        ):
            input_names = [self.values.columns(name, rows) for name in layer.inputs]
            self.values.give_columns(layer.name, number_by_number(*input_names), rows, layer.width)
        elif type(layer) in PLAIN:
            widths = [self.graph.width_of(name) for name in layer.inputs]
            input_names = [self.values.rows(name, rows) for name in layer.inputs]
            self.values.give(
                layer.name, PLAIN[type(layer)](self.nodes, layer, rows, input_names, widths), rows, layer.width
            )
        elif type(layer) in STEPS:
            self._recurrence(layer)
        else:
            raise refuse(layer)

    def _find_writer(self, layer: Layer) -> Callable[..., str] | None:
        """Return the writer of a layer that is independent of the element layout; None for other layers."""
        if isinstance(layer, layers.Activate):
            return partial(activate, self.nodes, layer.function)
        if isinstance(layer, layers.Elementwise) and layer.operation in CHANNELS_FIRST:
            return partial(combine, self.nodes, layer.operation)
        return None

    def _give(self, layer: Layer, value: str, rows: int) -> None:
        self.values.give(layer.name, value, rows, layer.width)

    def _difference(self, layer: memory.Difference, rows: int) -> None:
        nodes, reach = self.nodes, min(self.ticks, rows + 1)
        source = self.values.rows(layer.inputs[0], reach)
        before = nodes.split(source, [reach - 1, 1], 0)[:1] if reach > 1 else []
        if rows < reach:
            now = nodes.split(source, [1, rows], 0)[1]
        else:
            now, zero = source, nodes.constant(np.zeros((1, layer.width), np.float32), "zero")
            before.insert(
                0, zero if layer.from_zero else nodes.split(source, [1, rows - 1], 0)[0] if rows > 1 else source
            )
        self._give(layer, nodes.times(nodes.less(now, nodes.join(before, 0)), layer.factor), rows)

    def _starting(self, layer: memory.Starting, rows: int) -> None:
        nodes, first = self.nodes, self.ticks - rows
        read = (np.arange(first, self.ticks)[:, None] < layer.ticks).astype(np.float32)
        read_rows = nodes.times(self.values.rows(layer.inputs[0], rows), read)
        value = nodes.plus(read_rows, layer.mean * (1 - read))
        self._give(layer, nodes.join([value, nodes.constant(read, "read")], 1), rows)

    def _convolution(self, layer: memory.Convolution, rows: int) -> None:
        nodes, (out, taps, _) = self.nodes, layer.weight.shape
        past = (taps - 1) * layer.dilation
        reach = min(self.ticks, rows + past)
        convolved = nodes.add(
            "Conv",
            self.values.columns(layer.inputs[0], reach),
            nodes.constant(layer.weight.transpose(0, 2, 1), "weight"),
            nodes.constant(layer.bias, "bias"),
            kernel_shape=[taps],
            dilations=[layer.dilation],
            # Zeros in front stand for the ticks before the reset, as the ring does after it.
            pads=[rows + past - reach, 0],
        )
        self.values.give_columns(layer.name, convolved, rows, out)

    def _trailing_mean(self, layer: memory.TrailingMean, rows: int) -> None:
        nodes, reach = self.nodes, rows_before(layer, rows, self.ticks)
        source = self.values.rows(layer.inputs[0], reach)
        if rows == 1:
            self._give(layer, nodes.mean(source, 0), rows)
            return
        seen = self._mask_visible(layer.window, rows, reach)
        # Weights are known when the graph is written: at the start of a window fewer ticks count.
        weights = (seen / seen.sum(axis=1, keepdims=True)).astype(np.float32)
        self._give(layer, nodes.product(nodes.constant(weights, "weights"), source), rows)

    def _mask_visible(self, window: int, rows: int, reach: int) -> np.ndarray:
        """Return a mask of the last `reach` samples visible to each of the last `rows` samples, ``(rows, reach)``."""
        at, of = np.arange(reach - rows, reach)[:, None], np.arange(reach)[None]
        return (of <= at) & (of > at - window)

    def _mask_scores(self, window: int, rows: int, reach: int) -> str | None:
        """Return the term added to scores that masks invisible samples."""
        seen = self._mask_visible(window, rows, reach)
        return None if seen.all() else self.nodes.constant(np.where(seen, 0, UNSEEN).astype(np.float32), "hidden")

    def _attention_pool(self, layer: memory.AttentionPool, rows: int) -> None:
        nodes, reach = self.nodes, rows_before(layer, rows, self.ticks)
        source = self.values.rows(layer.inputs[0], reach)
        scores = nodes.shaped(nodes.linear(source, layer.score[None], layer.bias), 1, reach)
        hidden = self._mask_scores(layer.window, rows, reach)
        weights = nodes.softmax(scores if hidden is None else nodes.add("Add", scores, hidden))
        self._give(layer, nodes.product(weights, source), rows)

    def _window_attention(self, layer: memory.WindowAttention, rows: int) -> None:
        reach = rows_before(layer, rows, self.ticks)
        query = self.values.rows(layer.inputs[0], rows)
        keys, values = (self.values.rows(name, reach) for name in layer.inputs[1:])
        hidden = self._mask_scores(layer.window, rows, reach)
        self._give(layer, attend(self.nodes, layer, (query, keys, values), hidden), rows)

    def _recurrence(self, layer: Layer) -> None:
        """Write a layer that carries its state over the window, corrected after the first samples if trained."""
        nodes, ticks = self.nodes, self.ticks
        source = self.values.rows(layer.inputs[0], ticks)
        state = {
            slot.name: nodes.constant(self.graph.start(layer.name, slot).reshape(shape_of(slot)), "start")
            for slot in layer.slots
        }
        prefix = self.corrected.get(layer.name)
        if prefix is None:
            outputs, _ = self._run(layer, source, ticks, state)
        else:
            sizes = [prefix.ticks, ticks - prefix.ticks]
            early, late = nodes.split(source, sizes, 0)
            first, state = self._run(layer, early, sizes[0], state)
            for (owner, slot), part in self._correction(prefix).items():
                if owner == layer.name:
                    state[slot] = nodes.add("Add", state[slot], part)
            second, _ = self._run(layer, late, sizes[1], state)
            outputs = nodes.join([first, second], 0)
        self._give(layer, outputs, ticks)

    def _correction(self, layer: memory.PrefixCorrection) -> dict[tuple[str, str], str]:
        if layer.name not in self._parts:
            nodes, ticks = self.nodes, layer.ticks
            if not self.values.known(layer.inputs[0]):
                raise ExportError(
                    f"layer '{layer.name}' corrects layers that come before its input, which a window graph cannot "
                    "hold; use the graph of a tick"
                )
            rows = self.values.rows(layer.inputs[0], self.ticks)
            seen = nodes.split(rows, [ticks, self.ticks - ticks], 0)[0]
            last = nodes.split(seen, [ticks - 1, 1], 0)[1] if ticks > 1 else seen
            numbers = correct(nodes, layer, nodes.join([nodes.mean(seen, 0), last], 1))
            self._parts[layer.name] = corrections(nodes, self.graph, layer, numbers)
        return self._parts[layer.name]

    def _run(self, layer: Layer, source: str, ticks: int, state: dict[str, str]) -> tuple[str, dict[str, str]]:
        """Return the values ``(ticks, width)`` and the states after them."""
        if isinstance(layer, memory.Lstm) and layer.share == 1.0:
            return lstm(self.nodes, layer, source, ticks, state)
        # PyTorch's GRU resets behind the product, hence `linear_before_reset`.
        if isinstance(layer, memory.Gru):
            return gru(self.nodes, layer, source, ticks, state)
        tick_outputs = []
        for x in self.nodes.split(source, [1] * ticks, 0):
            value, state = STEPS[type(layer)](self.nodes, layer, state, x)
            tick_outputs.append(value)
        return self.nodes.join(tick_outputs, 0), state


WINDOWS = {
    memory.Difference: "difference",
    memory.Starting: "starting",
    memory.Convolution: "convolution",
    memory.TrailingMean: "trailing_mean",
    memory.AttentionPool: "attention_pool",
    memory.WindowAttention: "window_attention",
}
"""Methods of `Window` for layers with memory, by layer class."""


def _reorder_gates(array: np.ndarray, order: Sequence[int]) -> np.ndarray:
    """Return the gates in another order; a leading axis of one direction."""
    return np.concatenate([np.split(array, len(order))[at] for at in order])[None]


def _first(nodes: Nodes, state: str, units: int) -> str:
    # An all-zero start is the operator's default.
    """Return a state as an operator input; empty if it is zero."""
    return "" if nodes.is_zero(state) else nodes.shaped(state, 1, 1, units)


def lstm(
    nodes: Nodes, layer: memory.Lstm, source: str, ticks: int, state: Mapping[str, str]
) -> tuple[str, dict[str, str]]:
    """Write an LSTM; the gates of the ONNX operator are in the order i, o, f, c."""
    order, units = (0, 3, 1, 2), layer.width
    bias = np.concatenate([_reorder_gates(layer.bias, order), np.zeros((1, 4 * units), np.float32)], axis=1)
    y, h, c = nodes.several(
        "LSTM",
        [
            nodes.shaped(source, ticks, 1, layer.weight_x.shape[1]),
            nodes.constant(_reorder_gates(layer.weight_x, order), "w"),
            nodes.constant(_reorder_gates(layer.weight_h, order), "r"),
            nodes.constant(bias, "b"),
            "",
            _first(nodes, state["h"], units),
            _first(nodes, state["c"], units),
        ],
        3,
        hidden_size=units,
    )
    return nodes.shaped(y, ticks, units), {"h": nodes.shaped(h, 1, units), "c": nodes.shaped(c, 1, units)}


def gru(
    nodes: Nodes, layer: memory.Gru, source: str, ticks: int, state: Mapping[str, str]
) -> tuple[str, dict[str, str]]:
    """Write a GRU; the gates of the ONNX operator are in the order z, r, h, with the reset gate after the product."""
    order, units = (1, 0, 2), layer.width
    bias = np.concatenate([_reorder_gates(layer.bias_x, order), _reorder_gates(layer.bias_h, order)], axis=1)
    y, h = nodes.several(
        "GRU",
        [
            nodes.shaped(source, ticks, 1, layer.weight_x.shape[1]),
            nodes.constant(_reorder_gates(layer.weight_x, order), "w"),
            nodes.constant(_reorder_gates(layer.weight_h, order), "r"),
            nodes.constant(bias, "b"),
            "",
            _first(nodes, state["h"], units),
        ],
        2,
        hidden_size=units,
        linear_before_reset=1,
    )
    return nodes.shaped(y, ticks, units), {"h": nodes.shaped(h, 1, units)}


def window_model(graph: Graph, targets: int, name: str, notes: Mapping[str, str], opset: int = DEFAULT_OPSET) -> bytes:
    """Return the file of the window graph; arguments and errors as for `step_model`."""
    nodes = Nodes(opset)
    nodes.reserve(INPUTS, *graph.results)
    window = Window(nodes, graph)
    for layer in graph.layers:
        with nodes.inside(plain_name(layer.name)):
            window.add(layer)
    with nodes.inside("end"):
        # One row of all inputs: a single value that is not finite spoils the window.
        flat = nodes.shaped(INPUTS, 1, window.ticks * graph.inputs)
        ends = {value: window.values.rows(value, 1) for value in graph.results.values()}
        outputs = add_results(nodes, graph, ends, spoil(nodes, flat, ends.values()), targets)
    return nodes.model(name, {INPUTS: (window.ticks, graph.inputs)}, outputs, notes)
