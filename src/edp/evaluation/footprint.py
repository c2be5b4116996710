"""What a predictor costs to store and run, counted analytically, and held against a controller's budget."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch

from edp.models.predictor import Predictor
from edp.streaming import Cost, state_numbers


@dataclass(frozen=True)
class Budget:
    """What a controller grants (thesis 3.5.2 by default).

    Attributes:
        name: how reports call it.
        cycles: processor cycles per prediction: a 4 ms slice of a 180 MHz core.
        parameter_bytes: memory for parameters.
        ram_bytes: memory in all.
        flash_bytes: program memory.
    """

    name: str = "thesis 3.5.2: 180 MHz, 4 ms of a 10 ms task"
    cycles: int = 720_000
    parameter_bytes: int = 100_000
    ram_bytes: int = 500_000
    flash_bytes: int = 2_000_000


@dataclass(frozen=True)
class Footprint:
    """Counts of one predictor.

    Attributes:
        parameters: trainable numbers as stored.
        parameters_folded: after weight-norm gains and STanh amplitudes are merged into their neighbours.
        macs_window: multiply-accumulates of one prediction from a window of `window` samples (pooling left out, as
            in the thesis's tables).
        macs_tick: multiply-accumulates of one tick of the stream, pooling included.
        weight_bytes_fp32: folded weights at 4 bytes.
        weight_bytes_int8: folded weights at 1 byte.
        peak_activation_bytes: largest input plus output of one layer in a stream, float32.
        peak_activation_bytes_window: the same when a whole window is held.
        state_bytes: state carried from tick to tick, float32.
        window: W in samples.
        rows: costs by part.
    """

    parameters: int
    parameters_folded: int
    macs_window: int
    macs_tick: int
    weight_bytes_fp32: int
    weight_bytes_int8: int
    peak_activation_bytes: int
    peak_activation_bytes_window: int
    state_bytes: int
    window: int
    rows: tuple[dict[str, Any], ...]

    def to_json(self, budget: Budget) -> dict[str, Any]:
        """Plain values with the verdict against `budget`."""
        plain = asdict(self)
        plain["rows"] = list(self.rows)
        return plain | {"budget": asdict(budget), "verdict": self.verdict(budget)}

    def verdict(self, budget: Budget) -> list[dict[str, Any]]:
        """A row for each limit: value, limit, unit, whether it fits, and what the figure means."""
        ram = self.weight_bytes_fp32 + self.state_bytes + self.peak_activation_bytes
        bound = "a lower bound: at least one cycle per MAC on a scalar core, cycles are not measured here"
        rows = [
            ("cycles per tick, streaming", self.macs_tick, budget.cycles, "cycles", bound),
            ("cycles per prediction, windowed", self.macs_window, budget.cycles, "cycles", bound),
            ("parameters, FP32", self.weight_bytes_fp32, budget.parameter_bytes, "bytes", "folded weights"),
            ("parameters, INT8", self.weight_bytes_int8, budget.parameter_bytes, "bytes", "if quantised"),
            ("RAM, FP32", ram, budget.ram_bytes, "bytes", "weights, state and peak activation"),
            ("flash, FP32 weights", self.weight_bytes_fp32, budget.flash_bytes, "bytes", "without program code"),
        ]
        return [
            {"what": what, "value": value, "limit": limit, "unit": unit, "fits": value <= limit, "note": note}
            for what, value, limit, unit, note in rows
        ]


def footprint(predictor: Predictor) -> Footprint:
    """Count a predictor's parameters, multiply-accumulates, activations and state."""
    costs, window = predictor.costs(), predictor.spec.window
    column = sum(cost.per_column for cost in costs)
    once = sum(cost.per_prediction for cost in costs)
    folded = sum(cost.parameters - cost.foldable for cost in costs)
    like = torch.zeros(1)
    return Footprint(
        parameters=sum(cost.parameters for cost in costs),
        parameters_folded=folded,
        macs_window=column * window + once,
        macs_tick=column + once + sum(cost.pooling for cost in costs),
        weight_bytes_fp32=4 * folded,
        weight_bytes_int8=folded,
        peak_activation_bytes=4 * max(cost.width_in + cost.width_out for cost in costs),
        peak_activation_bytes_window=4 * max(_window_width(cost, window) for cost in costs),
        state_bytes=4 * state_numbers(predictor.initial_state(1, like)),
        window=window,
        rows=tuple(_row(cost, window) for cost in costs),
    )


def _window_width(cost: Cost, window: int) -> int:
    return (cost.width_in + cost.width_out) * (window if cost.per_time_step else 1)


def _row(cost: Cost, window: int) -> dict[str, Any]:
    return {
        "part": cost.part,
        "parameters": cost.parameters,
        "macs_tick": cost.per_column + cost.per_prediction + cost.pooling,
        "macs_window": cost.per_column * window + cost.per_prediction,
    }
