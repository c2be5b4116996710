"""Cost of storing and running a predictor, counted analytically and compared with a controller's budget."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import torch

from edp.errors import ConfigError, ExportError
from edp.evaluation.controller import CORES, Budget, Estimate, LimitCheck, estimate
from edp.evaluation.footprint_file import PartCost
from edp.export.c.sizes import Sizes, sizes_of
from edp.ir import Graph
from edp.ir.rls import Adaptation
from edp.ir.w8a16.quantise import outline
from edp.networks.predictor import Predictor
from edp.networks.streaming import Cost, state_numbers
from edp.settings.results import plain_value

GRAPHS: dict[str, Callable[[Predictor], Graph]] = {
    "float32": lambda predictor: predictor.graph(),
    "w8a16": lambda predictor: outline(predictor.graph()),
}
"""Functions that return the layer graph of a network, by number format of `FORMATS`."""


@dataclass(frozen=True)
class Footprint:
    """Counts of one predictor.

    Attributes:
        parameters: trainable numbers as stored.
        parameters_folded: after weight-norm gains and STanh amplitudes are merged into their neighbours.
        macs_window: multiply-accumulates of one prediction from a window of `window` samples (pooling left out, as
            in the thesis's tables).
        macs_tick: multiply-accumulates of one tick of the stream, pooling included.
        peak_activation_bytes: largest input plus output of one layer in a stream, float32.
        peak_activation_bytes_window: peak activation memory when a whole window is stored.
        state_bytes: state carried from tick to tick, float32.
        window: W in samples.
        rows: costs by part.
        estimates: bytes, cycles and memory of a stream in each number format that the network has a form in.
        refused: why it has none in the others, by number format.
    """

    parameters: int
    parameters_folded: int
    macs_window: int
    macs_tick: int
    peak_activation_bytes: int
    peak_activation_bytes_window: int
    state_bytes: int
    window: int
    rows: tuple[PartCost, ...]
    estimates: tuple[Estimate, ...]
    refused: dict[str, str]

    def estimate(self, number_format: str) -> Estimate:
        """Return the estimate of a number format.

        Raises:
            ExportError: the network has no form in it.
        """
        for entry in self.estimates:
            if entry.number_format == number_format:
                return entry
        raise ExportError(self.refused[number_format])

    def to_json(self, budget: Budget | None = None) -> dict[str, object]:
        """Return plain values, with the verdict against a budget where one is given."""
        plain = asdict(self)
        plain |= {"rows": plain_value(self.rows), "estimates": [entry.to_json() for entry in self.estimates]}
        if budget is None:
            return plain
        return plain | {"budget": asdict(budget), "verdict": plain_value(self.verdict(budget))}

    def verdict(self, budget: Budget) -> list[LimitCheck]:
        """Return one row per limit: value, limit, unit, whether it fits, and the meaning of the figure."""
        bound = "a lower bound: at least one cycle per MAC on a scalar core"
        rows = [("cycles per prediction, windowed", self.macs_window, budget.cycles, "cycles", bound)]
        for entry in self.estimates:
            label = entry.number_format
            low, typical, high = entry.cycles[budget.core]
            range_text = f"high estimate for a {CORES[budget.core].label}; low {low:,}, typical {typical:,}"
            constants, memory = entry.parameter_bytes, entry.parameter_bytes + entry.ram_bytes
            rows += [
                (f"cycles per tick, {label}", high, budget.cycles, "cycles", range_text),
                (f"parameters, {label}", constants, budget.parameter_bytes, "bytes", "all constants of the C code"),
                (f"RAM, {label}", memory, budget.ram_bytes, "bytes", "constants too, as in the thesis"),
                (f"flash, {label}", entry.flash_bytes, budget.flash_bytes, "bytes", "estimate, with the program"),
            ]
        return [LimitCheck(what, value, limit, unit, value <= limit, note) for what, value, limit, unit, note in rows]


def footprint(predictor: Predictor, adaptation: Adaptation | None = None) -> Footprint:
    """Count a predictor's parameters, multiply-accumulates, activations and state, including its adaptation."""
    costs, window = predictor.costs(), predictor.spec.window
    state = state_numbers(predictor.initial_state(1, torch.zeros(1)))
    if adaptation is not None:
        costs, state = [*costs, adaptation_cost(adaptation)], state + adaptation.state_numbers
    column = sum(cost.per_column for cost in costs)
    once = sum(cost.per_prediction for cost in costs)
    folded = sum(cost.parameters - cost.foldable for cost in costs)
    parameters, macs_tick = parameters_and_macs(costs)
    sizes, refused = _sizes(predictor, adaptation)
    return Footprint(
        parameters=parameters,
        parameters_folded=folded,
        macs_window=column * window + once,
        macs_tick=macs_tick,
        # Four bytes a number: activations are counted in float32 in both formats.
        peak_activation_bytes=4 * max(cost.width_in + cost.width_out for cost in costs),
        peak_activation_bytes_window=4 * max(_window_width(cost, window) for cost in costs),
        state_bytes=4 * state,
        window=window,
        rows=tuple(_row(cost, window) for cost in costs),
        estimates=tuple(estimate(costs, state, name, size) for name, size in sizes.items()),
        refused=refused,
    )


def parameters_and_macs(costs: Sequence[Cost]) -> tuple[int, int]:
    """Return the stored trainable parameters, and the multiply-accumulates per stream sample of the parts alone."""
    macs = sum(cost.per_column + cost.per_prediction + cost.pooling for cost in costs)
    return sum(cost.parameters for cost in costs), macs


def _sizes(predictor: Predictor, adaptation: Adaptation | None) -> tuple[dict[str, Sizes], dict[str, str]]:
    """Return the sizes by number format, and the reasons for missing formats."""
    sizes: dict[str, Sizes] = {}
    refused: dict[str, str] = {}
    for name, in_format in GRAPHS.items():
        try:
            sizes[name] = sizes_of(in_format(predictor), adaptation)
        except ExportError as error:
            # A network without an integer form still has a footprint; the reason is shown in place of figures.
            refused[name] = str(error)
    return sizes, refused


def adaptation_cost(adaptation: Adaptation) -> Cost:
    """Return the cost of an adaptation: constants, and multiply-accumulates of a learning sample."""
    constants = sum(values.size for values in adaptation.arrays().values()) + adaptation.dead_zone.size
    return Cost(
        f"adaptation, {adaptation.features} features",
        constants,
        per_prediction=adaptation.macs,
        width_in=len(adaptation.offset),
        width_out=adaptation.unit.size,
        per_time_step=False,
    )


def check_possible(budget: Budget, least: Footprint) -> None:
    """Refuse a budget that not even the smallest network meets.

    Args:
        budget: limits of the controller.
        least: resource usage of the narrowest network for the same inputs and targets.

    Raises:
        ConfigError: each limit that is too small, and what the smallest network needs.
    """
    if not least.estimates:
        return  # nothing is known of what it takes
    needs = {
        "cycles": min(entry.cycles[budget.core][2] for entry in least.estimates),
        "parameter_bytes": min(entry.parameter_bytes for entry in least.estimates),
        "ram_bytes": min(entry.parameter_bytes + entry.ram_bytes for entry in least.estimates),
        "flash_bytes": min(entry.flash_bytes for entry in least.estimates),
    }
    short = [f"{what} = {getattr(budget, what):,}" for what, need in needs.items() if getattr(budget, what) < need]
    if short:
        least_text = ", ".join(f"{what} {need:,}" for what, need in needs.items())
        raise ConfigError(
            f"budget '{budget.name}': {', '.join(short)} can be met by no network of these inputs and targets; one "
            f"of a single unit, with integer weights, takes {least_text}: raise the limits, or read fewer channels"
        )


def _window_width(cost: Cost, window: int) -> int:
    return (cost.width_in + cost.width_out) * (window if cost.per_time_step else 1)


def _row(cost: Cost, window: int) -> PartCost:
    return PartCost(
        part=cost.part,
        parameters=cost.parameters,
        macs_tick=cost.per_column + cost.per_prediction + cost.pooling,
        macs_window=cost.per_column * window + cost.per_prediction,
    )
