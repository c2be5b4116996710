"""Calibration: ranges of all values and input moments of the weights, measured on recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.ir.arithmetic import RUNTIME
from edp.ir.base import INPUT, Graph, LayerRun, Values
from edp.ir.layers import Standardise
from edp.ir.memory import Rotation
from edp.ir.reference import Reference
from edp.ir.w8a16.balance import balanced
from edp.ir.w8a16.moments import InputMoments
from edp.ir.w8a16.parts import integer_part
from edp.ir.w8a16.quantise import Formats, formats, quantise, weights_of

# 500 ticks are 5 s at 100 Hz: longer than the networks remember, so that a piece shows steady values.
PIECE = 500
"""Length of a calibration segment in samples; each segment starts from reset."""
# Errors of neighbouring formats are noisy; one finer format without gain is no sign of the end.
PATIENCE = 2


def calibrate(
    graph: Graph,
    recordings: Sequence[NDArray[np.floating]],
    ticks: int = 20_000,
    error_of: Callable[[int], float] | None = None,
) -> Formats:
    """Choose formats of all values and 8-bit weights from recordings.

    Values before the first weights are calibrated on all samples, since clipped inputs cause the largest errors; all
    other values are calibrated on segments of `PIECE` samples spread evenly over all recordings. All inputs have one
    format. If a few inputs (derivatives) are very large at rare times, a finer format that clips them may cause smaller
    errors than a coarse format.

    Args:
        graph: the float network.
        recordings: inputs ``(time, input)`` in SI units, of the training part.
        ticks: approximate number of samples that run through the whole network.
        error_of: function that returns the network's error for a number of fractional bits of the standardised inputs;
            None selects the format without clipping.

    Raises:
        ExportError: a part of the network has no integer form.
    """
    graph = balanced(graph)
    ranges: dict[str, float] = {}
    moments = InputMoments(graph)
    for rows in recordings:
        # Values before the first weights are cheap: their range is taken over all ticks, not over a sample.
        for name, values in _compute_inputs(graph, rows).items():
            _raise(ranges, name, values)
    for rows in pieces(recordings, ticks):
        moments.add(_follow(graph, rows, ranges))
    chosen = formats(ranges)
    if error_of is not None:
        # Only the inputs' formats are tried: derivatives reach 50 deviations, which wastes bits of all others.
        names = [layer.name for layer in graph.layers if isinstance(layer, Standardise) and layer.name in chosen.fracs]
        fracs = {name: finer(chosen.fracs[name], error_of) for name in names}
        chosen = replace(chosen, fracs={**chosen.fracs, **fracs})
    return replace(chosen, weights=weights_of(quantise(graph, chosen, moments.means())))


def finer(frac: int, error_of: Callable[[int], float]) -> int:
    """Return the format with the least error, searching from `frac` until `PATIENCE` finer formats bring no gain."""
    best, error, candidate = frac, error_of(frac), frac
    while candidate - best < PATIENCE:
        candidate += 1
        if (candidate_error := error_of(candidate)) < error:
            best, error = candidate, candidate_error
    return best


def pieces(recordings: Sequence[NDArray[np.floating]], ticks: int) -> list[NDArray[np.floating]]:
    """Return evenly spaced segments of recordings with about `ticks` samples in total."""
    total = sum(len(rows) for rows in recordings)
    share = min(1.0, ticks / max(1, total))
    cut = []
    for rows in recordings:
        count = max(1, round(share * len(rows) / PIECE))
        # Even distances cover a whole recording; its beginning alone could be a standstill.
        starts = np.linspace(0, max(0, len(rows) - PIECE), count).astype(int)
        cut += [rows[start : start + PIECE] for start in starts]
    return cut


def _compute_inputs(graph: Graph, rows: NDArray[np.floating]) -> dict[str, Values]:
    inside = integer_part(graph)
    values: dict[str, Values] = {INPUT: np.asarray(rows, dtype=np.float32)[:, None]}
    for layer in graph.layers:
        inputs_computed = layer.inputs and set(layer.inputs) <= set(values)
        if inputs_computed and layer.name not in inside and layer.bit_exact:
            memory = {slot.name: graph.start(layer.name, slot).astype(np.float32) for slot in layer.slots}
            run = LayerRun(layer.tensors(), memory, {}, RUNTIME)
            values[layer.name] = layer.over_time(run, *(values[name] for name in layer.inputs))
    return values


def _follow(graph: Graph, rows: NDArray[np.floating], ranges: dict[str, float]) -> dict[str, Values]:
    """Return the values of every layer at every tick, ``(time, number)``."""
    values = {name: value[:, 0] for name, value in Reference(graph).values(rows[:, None]).items()}
    for name, value in values.items():
        _raise(ranges, name, value)
    for layer in graph.layers:
        if isinstance(layer, Rotation):
            # The value of the layer is its state, which has a separate format.
            _raise(ranges, f"{layer.name}/h", values[layer.name])
    return values


def _raise(ranges: dict[str, float], name: str, values: Any) -> None:
    if np.size(values):
        ranges[name] = max(ranges.get(name, 0.0), float(np.abs(values).max()))
