"""Controller budgets, and estimates of the cycles, flash and memory of a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from edp.errors import ConfigError, closest
from edp.settings.bounds import check_bounds, integer
from edp.settings.tree import SettingsTree
from edp.storage import read_toml

if TYPE_CHECKING:  # exports bring torch, which a command that shows a page does without
    from edp.export.c.sizes import Sizes
    from edp.networks.streaming import Cost

STACK_BYTES = 1_024  # an allowance: a tick was seen to take 340 (``benchmarks/controller_memory.py``)
# Published boards against zero-wait memory (flash wait states): the best, and the slowest, which decides.
BOARD_TYPICAL, BOARD_SLOW = 1.26, 1.43


MAX_GRANTED = 2**53
"""Maximum number of cycles or bytes. Larger integers are not exact as floats."""


@dataclass(frozen=True)
class NumberFormat:
    """Numbers of a deployed network, with cycles of a step of them on a Cortex-M4F with zero-wait memory.

    Fitted to the exported code of nine networks of 28 K to 223 K multiply-accumulates, whose instructions were counted
    and timed (``benchmarks/controller_cycles.py --fit``). An LSTM alone takes up to 12 % more, convolutions alone up to
    10 % less.

    Attributes:
        state_bytes: bytes per number of state and working memory, the maximum of all measured networks.
        per_mac: cycles of a multiply-accumulate.
        per_output: cycles of a feature that a part writes.
        per_tree_step: cycles of a comparison of a regression tree, or of taking its leaf.
    """

    state_bytes: float
    per_mac: float
    per_output: float
    per_tree_step: float


FORMATS = {
    "float32": NumberFormat(4.6, 4.05, 40.0, 19.0),
    "w8a16": NumberFormat(3.1, 2.14, 98.0, 16.0),
}


@dataclass(frozen=True)
class LimitCheck:
    """Comparison of a network with one limit of a controller.

    Attributes:
        what: the resource.
        value, limit: value and limit in `unit`.
        fits: whether the value is within the limit.
        note: method of estimation.
    """

    what: str
    value: int
    limit: int
    unit: str
    fits: bool
    note: str


@dataclass(frozen=True)
class ProcessorCore:
    """Processor core with its cycle counts relative to a Cortex-M4F.

    Attributes:
        label: name in tables.
        low: factor in the best case.
        typical: typical factor.
    """

    label: str
    low: float
    typical: float


# The M33 has the instructions of the M4F. The M7 can issue two at a time: half the cycles at best; as a rule the ratio
# of the CoreMark figures 3.40 and 5.01 per MHz. In the high estimate no core is faster than an M4F.
CORES = {
    "cortex_m4f": ProcessorCore("Cortex-M4F", 1.0, 1.0),
    "cortex_m7": ProcessorCore("Cortex-M7", 0.5, 0.68),
    "cortex_m33": ProcessorCore("Cortex-M33", 1.0, 1.0),
}


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Resource limits of the target controller (default: thesis, section 3.5.2).

    Attributes:
        name: name in reports.
        core: a name of `CORES`.
        cycles: processor cycles per prediction: a 4 ms slice of a 180 MHz core.
        parameter_bytes: memory for parameters.
        ram_bytes: memory in all.
        flash_bytes: program memory.

    Raises:
        ConfigError: an unknown core, or a limit below 1.
    """

    name: str = "default controller: 180 MHz, 4 ms of a 10 ms task"
    core: str = "cortex_m4f"
    cycles: int = 720_000
    parameter_bytes: int = 100_000
    ram_bytes: int = 500_000
    flash_bytes: int = 2_000_000

    def __post_init__(self) -> None:
        if self.core not in CORES:
            raise ConfigError(f"budget: core = '{self.core}' is not known{closest(self.core, CORES)}")
        limits = ("cycles", "parameter_bytes", "ram_bytes", "flash_bytes")
        check_bounds("budget", self, **dict.fromkeys(limits, integer(1, MAX_GRANTED)))


@dataclass(frozen=True)
class ResourceUsage:
    """Resource usage of a network in one format; cycles and memory other than weights and program are estimates.

    Attributes:
        parameters: trainable numbers, after folding.
        macs_tick: multiply-accumulates of a tick.
        macs_window: multiply-accumulates of a window, as the thesis counts them.
        cycles: low, typical and high estimate of a tick; the high one decides.
        parameter_bytes: memory for parameters.
        ram_bytes: weights, state, working memory and stack.
        flash_bytes: weights and program.
    """

    parameters: int
    macs_tick: int
    macs_window: int
    cycles: tuple[int, int, int]
    parameter_bytes: int
    ram_bytes: int
    flash_bytes: int

    def over(self, budget: Budget) -> dict[str, tuple[int, int]]:
        """Return the exceeded limits with usage and limit."""
        # The high estimate of cycles decides: a deadline that is missed at times is missed.
        pairs = {
            "cycles": (self.cycles[2], budget.cycles),
            "parameter_bytes": (self.parameter_bytes, budget.parameter_bytes),
            "ram_bytes": (self.ram_bytes, budget.ram_bytes),
            "flash_bytes": (self.flash_bytes, budget.flash_bytes),
        }
        return {name: pair for name, pair in pairs.items() if pair[0] > pair[1]}


BUDGET_FILE = SettingsTree(what="budget")


def load_budget(path: str | Path) -> Budget:
    """Load a budget from a TOML file with the fields of `Budget`; missing fields are as in the thesis.

    Raises:
        ConfigError: the file cannot be read, or holds something else than a budget.
    """
    table = read_toml(path, f"budget '{path}'", ConfigError)
    return BUDGET_FILE.build(Budget, {"name": Path(path).stem} | table, f"'{path}'")


@dataclass(frozen=True)
class Estimate:
    """Estimated resource usage of a network as a stream, in one number format, as exported C code.

    Bytes of constants are counted and are those of the compiled code; the others are estimates, not measurements.

    Attributes:
        number_format: a name of `FORMATS`.
        cycles: low, typical and high estimate of a tick by core; the high one decides.
        parameter_bytes: constants of the model on a 32-bit controller: weights, multipliers, shifts, biases, and all
            else that the C code of the model holds in read-only memory.
        program_bytes: code, and tables of functions; within 2 %.
        ram_bytes: state, working memory and an allowance of `STACK_BYTES` for the stack.
    """

    number_format: str
    cycles: dict[str, tuple[int, int, int]]
    parameter_bytes: int
    program_bytes: int
    ram_bytes: int

    @property
    def flash_bytes(self) -> int:
        """Constants and program."""
        return self.parameter_bytes + self.program_bytes

    def to_json(self) -> dict[str, object]:
        """Return the plain values."""
        return asdict(self) | {"flash_bytes": self.flash_bytes}


def estimate(costs: Sequence[Cost], state_numbers: int, number_format: str, sizes: Sizes) -> Estimate:
    """Estimate a network in one number format.

    Args:
        costs: costs of all parts.
        state_numbers: number of state values.
        number_format: a name of `FORMATS`.
        sizes: sizes of its C code in this format.
    """
    form = FORMATS[number_format]
    macs = sum(cost.per_column + cost.per_prediction + cost.pooling for cost in costs)
    outputs = sum(cost.width_out for cost in costs)
    # Products and element-wise outputs are counted apart: in W8A16 an output weighs as much as 46 products.
    step = macs * form.per_mac + outputs * form.per_output
    step += sum(cost.tree_steps for cost in costs) * form.per_tree_step
    cycles = {
        # Only the high estimate decides: a tick that sometimes misses its deadline misses it.
        name: (round(step * core.low), round(step * core.typical * BOARD_TYPICAL), round(step * BOARD_SLOW))
        for name, core in CORES.items()
    }
    # The stack is an allowance, since compilers differ in what they keep on it.
    working = round(form.state_bytes * state_numbers)
    return Estimate(number_format, cycles, sizes.constants, sizes.program, working + STACK_BYTES)
