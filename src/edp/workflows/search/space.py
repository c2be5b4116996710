"""Dimensions of a search other than modules, each with a range and a function that sets its value."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from edp.errors import ConfigError
from edp.networks.convolution import receptive_field
from edp.networks.heads import HEADS
from edp.networks.losses import Smoothness
from edp.registry import Registry
from edp.settings.bounds import MAX_NAMES, check_bounds, check_count, span
from edp.workflows.search.arms import Arm

Value = float | int | str
REAL = span(-1e30, 1e30)
"""Ends of a range, whose difference must be a finite number too."""


@dataclass(frozen=True)
class Real:
    """A number between two bounds, uniform or uniform in its logarithm.

    Attributes:
        low: lower bound.
        high: upper bound.
        log: whether the number is uniform in its logarithm.

    Raises:
        ConfigError: bounds that hold nothing, or that have no logarithm.
    """

    low: float
    high: float
    log: bool = False

    def __post_init__(self) -> None:
        check_bounds("a range", self, low=REAL, high=REAL)
        if not self.low < self.high:
            raise ConfigError(f"a range from {self.low} to {self.high}; low < high, both finite, must hold")
        if self.log and self.low <= 0:
            raise ConfigError(f"a logarithmic range from {self.low}; low > 0 must hold")

    def holds(self, value: Value) -> bool:
        """Test whether a value is in the range."""
        return isinstance(value, float | int) and self.low <= value <= self.high

    def around(self, value: float, reach: float, beyond: bool = False) -> Real:
        """Return the part within `reach` of a value, in decades if logarithmic (thesis 3.3.3).

        Args:
            value: the middle.
            reach: distance to both sides.
            beyond: whether it may leave the range, as in the thesis; what is not logarithmic then stays in [0, 1].
        """
        # Reach is in decades for logarithmic ranges, as in the thesis.
        if self.log:
            low, high = value / 10.0**reach, value * 10.0**reach
        else:
            low, high = value - reach, value + reach
        if beyond:
            # Rates such as dropout have no meaning outside of 0 to 1.
            return Real(low, high, self.log) if self.log else Real(max(0.0, low), min(1.0, high))
        return Real(max(self.low, low), min(self.high, high), self.log)


@dataclass(frozen=True)
class Choice:
    """One of some values, in ascending order of cost where they have one.

    Attributes:
        options: the values, each once.

    Raises:
        ConfigError: fewer than two values, or one twice.
    """

    options: tuple[Value, ...]

    def __post_init__(self) -> None:
        check_count("a choice", "options", self.options, MAX_NAMES)
        if len(self.options) < 2 or len(set(self.options)) < len(self.options):
            raise ConfigError(f"a choice of {list(self.options)}; two values or more, each once, must hold")

    def holds(self, value: Value) -> bool:
        """Return whether a value is among the options."""
        return value in self.options


Range = Real | Choice
Space = Mapping[str, Range]
Candidate = Mapping[str, Value]
UNITS, CHANNELS, KERNEL = "model.backbone.units", "model.backbone.channels", "model.backbone.kernel"

DIMENSIONS: Registry[Callable[[Arm, Any], Arm]] = Registry("dimension")
"""By name, what gives an arm a value."""


@DIMENSIONS.register("learning_rate")
def _learning_rate(arm: Arm, value: float) -> Arm:
    return arm.with_value("training.optimizer.learning_rate", float(value))


@DIMENSIONS.register("weight_decay")
def _weight_decay(arm: Arm, value: float) -> Arm:
    return arm.with_value("training.optimizer.weight_decay", float(value))


@DIMENSIONS.register("dropout")
def _dropout(arm: Arm, value: float) -> Arm:
    return arm.with_value("model.backbone.dropout", float(value))


@DIMENSIONS.register("units")
def _units(arm: Arm, value: int) -> Arm:
    """Return the hidden unit capacity C: recurrent units, and channels of every convolution."""
    if UNITS in arm:
        arm = arm.with_value(UNITS, int(value))
    if CHANNELS in arm:
        arm = arm.with_value(CHANNELS, [int(value)] * len(arm[CHANNELS]))
    return arm


@DIMENSIONS.register("layers")
def _layers(arm: Arm, value: int) -> Arm:
    """Return the layer depth L: convolutions where the backbone has them, else recurrent layers."""
    if CHANNELS in arm:
        return arm.with_value(CHANNELS, [arm[CHANNELS][-1]] * int(value))
    return arm.with_value("model.backbone.layers", int(value))


@DIMENSIONS.register("kernel")
def _kernel(arm: Arm, value: int) -> Arm:
    return arm.with_value(KERNEL, int(value))


@DIMENSIONS.register("loss")
def _loss(arm: Arm, value: str) -> Arm:
    return arm if arm["training.loss.kind"] == value else arm.with_value("training.loss", {"kind": str(value)})


SCHEDULES: dict[str, dict[str, float | str]] = {
    # Factor, patience and threshold of appendix B.1.1.
    "plateau": {"kind": "plateau", "factor": 0.5, "patience": 5, "threshold": 1e-4},
    # Annealed to zero, as PyTorch's schedule does by default; B.1.1 has no warm-up.
    "cosine": {"kind": "cosine", "warmup": 0.0, "min_lr_ratio": 0.0},
}
"""The two schedules of thesis 3.2.4.2."""


@DIMENSIONS.register("schedule")
def _schedule(arm: Arm, value: str) -> Arm:
    same = arm["training.schedule.kind"] == value
    return arm if same else arm.with_value("training.schedule", SCHEDULES[value])


@DIMENSIONS.register("patience")
def _patience(arm: Arm, value: int) -> Arm:
    """Set the patience of a plateau schedule in epochs; other schedules are unchanged."""
    is_plateau = arm["training.schedule.kind"] == "plateau"
    return arm.with_value("training.schedule.patience", int(value)) if is_plateau else arm


@DIMENSIONS.register("smoothness")
def _smoothness(arm: Arm, value: float) -> Arm:
    """Set the weight of the smoothness term; with it, windows are sampled in runs that have second differences."""
    terms = [term for term in arm["training.terms"] if term["kind"] != "smoothness"]
    if not value:
        return arm.with_value("training.terms", terms)
    arm = arm.with_value("training.terms", [*terms, {"kind": "smoothness", "weight": float(value)}])
    if arm["training.chunks.regime"] == "window" and arm.get("training.chunks.consecutive", 1) < Smoothness.span:
        batch = int(arm["training.chunks.batch"])
        fitting = (size for size in range(Smoothness.span, batch + 1) if batch % size == 0)
        arm = arm.with_value("training.chunks.consecutive", next(fitting, Smoothness.span))
    return arm


THESIS: Space = {
    "learning_rate": Real(1e-4, 5e-3, log=True),
    "weight_decay": Real(1e-5, 1e-2, log=True),
    "dropout": Real(0.05, 0.40),
    "units": Choice((64, 128, 256, 512)),
    "layers": Choice((1, 2, 3, 4)),
    "kernel": Choice((3, 5, 7)),
    "loss": Choice(("mse", "huber")),
}
"""The space of phase 1, thesis 3.3.2."""

ELASTIC = {"learning_rate": 1.0, "weight_decay": 1.0, "dropout": 0.15}
"""Reach of the window around the calibrated baseline in phase 2, thesis 3.3.3: decades, decades, rate."""


def apply(arm: Arm, candidate: Candidate) -> Arm:
    """Return an arm with the values of a candidate.

    Raises:
        ConfigError: an unknown dimension.
    """
    # The order of the registry, depth after width: equal candidates give equal arms.
    for name in DIMENSIONS:
        if name in candidate:
            arm = DIMENSIONS[name](arm, candidate[name])
    unknown = [name for name in candidate if name not in DIMENSIONS]
    if unknown:
        _ = DIMENSIONS[unknown[0]]
    return arm


def applicable(space: Space, arm: Arm) -> Space:
    """Return the dimensions that affect this arm: a pure LSTM has no kernel."""
    return {name: dimension for name, dimension in space.items() if name != "kernel" or KERNEL in arm}


def halved(arm: Arm) -> Arm:
    """Return an arm with the widths of the thesis's printed parameter counts (Tables B.1, 4.8 and 4.9).

    Channels start at C and halve from level to level. The hidden layers of a head are C / 2 wide where there is one of
    them and C / 4 where there are more. A pure TCN gets as many levels as its receptive field needs for the window
    (R >= W, thesis 3.2.3.2).
    """
    channels = arm.get(CHANNELS) or [1]
    width = int(arm.get(UNITS, channels[0]))
    if CHANNELS in arm:
        levels = len(arm[CHANNELS])
        while arm["model.backbone.kind"] == "tcn" and receptive_field(levels, arm[KERNEL]) < arm["model.window"]:
            if arm[KERNEL] < 2:
                break  # which sees one sample, however many levels there are
            levels += 1
        arm = arm.with_value(CHANNELS, [max(1, width >> level) for level in range(levels)])
    if hasattr(HEADS[arm["model.head.kind"]], "hidden"):
        part = 2 if arm.get("model.head.layers", 1) == 1 else 4
        arm = arm.with_value("model.head.hidden", max(1, width // part))
    return arm


WIDTHS: dict[str, Callable[[Arm], Arm]] = {"equal": lambda arm: arm, "halved": halved}
"""How widths follow from the hidden unit capacity: as they are, or as in the thesis."""


def elastic(space: Space, baseline: Candidate, reach: Mapping[str, float] = ELASTIC, beyond: bool = False) -> Space:
    """Return the window around a baseline for the tuning of candidates in phase 2; other dimensions are unchanged.

    Args:
        space: space of phase 1.
        baseline: its values.
        reach: distance to both sides, by dimension.
        beyond: whether the window may leave the space, as in thesis 3.3.3.

    Raises:
        ConfigError: the baseline lacks a value or has one outside the space.
    """
    window: dict[str, Range] = {}
    for name, share in reach.items():
        dimension = space.get(name)
        if not isinstance(dimension, Real):
            continue
        check({name: dimension}, baseline)
        window[name] = dimension.around(float(baseline[name]), share, beyond)
    return window


def check(space: Space, candidate: Candidate) -> None:
    """Raise an error for a candidate that lacks a dimension of the space or is outside it.

    Raises:
        ConfigError: a dimension is missing or out of range; the message states value and range.
    """
    for name, dimension in space.items():
        if name not in candidate:
            raise ConfigError(f"the candidate {dict(candidate)} has no value of '{name}'; {dimension} must hold it")
        if not dimension.holds(candidate[name]):
            raise ConfigError(
                f"{name} = {candidate[name]!r} is not in {dimension}; choose a value inside, or widen the space"
            )


def names(space: Space) -> Sequence[str]:
    """Return the dimensions in the order of the registry, so that a sampler always sees the same one.

    Others behind, in theirs.
    """
    return [name for name in DIMENSIONS if name in space] + [name for name in space if name not in DIMENSIONS]
