"""Dimensions of a search apart from modules: each has a range and changes an experiment's settings."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from edp.config.experiment import Table
from edp.errors import ConfigError
from edp.networks.convolution import receptive_field
from edp.networks.heads import HEADS
from edp.networks.losses import Smoothness
from edp.registry import Registry
from edp.settings.bounds import MOST_NAMES, check_bounds, check_count, span

Value = float | int | str
REAL = span(-1e30, 1e30)
"""Ends of a range, whose difference must be a finite number too."""


@dataclass(frozen=True)
class Real:
    """A number between two bounds, uniform or uniform in its logarithm.

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
        """Test whether a value lies in the range."""
        return isinstance(value, float | int) and self.low <= value <= self.high

    def around(self, value: float, reach: float, beyond: bool = False) -> Real:
        """Return the part within `reach` of a value, in decades if logarithmic (thesis 3.3.3).

        Args:
            value: the middle.
            reach: to both sides.
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

    Raises:
        ConfigError: fewer than two values, or one twice.
    """

    options: tuple[Value, ...]

    def __post_init__(self) -> None:
        check_count("a choice", "options", self.options, MOST_NAMES)
        if len(self.options) < 2 or len(set(self.options)) < len(self.options):
            raise ConfigError(f"a choice of {list(self.options)}; two values or more, each once, must hold")

    def holds(self, value: Value) -> bool:
        """Test whether a value is one of the options."""
        return value in self.options


Range = Real | Choice
Space = Mapping[str, Range]
Candidate = Mapping[str, Value]

DIMENSIONS: Registry[Callable[[Table, Any], None]] = Registry("dimension")
"""By name, what sets a value in settings, in place."""


@DIMENSIONS.register("learning_rate")
def _learning_rate(settings: Table, value: float) -> None:
    settings["training"]["optimizer"]["learning_rate"] = float(value)


@DIMENSIONS.register("weight_decay")
def _weight_decay(settings: Table, value: float) -> None:
    settings["training"]["optimizer"]["weight_decay"] = float(value)


@DIMENSIONS.register("dropout")
def _dropout(settings: Table, value: float) -> None:
    settings["model"]["backbone"]["dropout"] = float(value)


@DIMENSIONS.register("units")
def _units(settings: Table, value: int) -> None:
    """Hidden unit capacity C: recurrent units, and channels of every convolution."""
    backbone = settings["model"]["backbone"]
    if "units" in backbone:
        backbone["units"] = int(value)
    if "channels" in backbone:
        backbone["channels"] = [int(value)] * len(backbone["channels"])


@DIMENSIONS.register("layers")
def _layers(settings: Table, value: int) -> None:
    """Layer depth L: convolutions where the backbone has them, else recurrent layers."""
    backbone = settings["model"]["backbone"]
    if "channels" in backbone:
        backbone["channels"] = [backbone["channels"][-1]] * int(value)
    else:
        backbone["layers"] = int(value)


@DIMENSIONS.register("kernel")
def _kernel(settings: Table, value: int) -> None:
    settings["model"]["backbone"]["kernel"] = int(value)


@DIMENSIONS.register("loss")
def _loss(settings: Table, value: str) -> None:
    if settings["training"]["loss"]["kind"] != value:
        settings["training"]["loss"] = {"kind": str(value)}


SCHEDULES: dict[str, Table] = {
    # Factor, patience and threshold of appendix B.1.1.
    "plateau": {"kind": "plateau", "shrink": 0.5, "patience": 5, "threshold": 1e-4},
    # Annealed to zero, as PyTorch's schedule does by default; B.1.1 has no warm-up.
    "cosine": {"kind": "cosine", "warmup": 0.0, "floor": 0.0},
}
"""The two schedules of thesis 3.2.4.2."""


@DIMENSIONS.register("schedule")
def _schedule(settings: Table, value: str) -> None:
    if settings["training"]["schedule"]["kind"] != value:
        settings["training"]["schedule"] = dict(SCHEDULES[value])


@DIMENSIONS.register("patience")
def _patience(settings: Table, value: int) -> None:
    """Set the patience of a plateau in epochs; other schedules have none."""
    if settings["training"]["schedule"]["kind"] == "plateau":
        settings["training"]["schedule"]["patience"] = int(value)


@DIMENSIONS.register("smoothness")
def _smoothness(settings: Table, value: float) -> None:
    """Set the weight of the smoothness term; with it, windows are drawn in runs that have second differences."""
    training = settings["training"]
    training["terms"] = [term for term in training["terms"] if term["kind"] != "smoothness"]
    if not value:
        return
    training["terms"].append({"kind": "smoothness", "weight": float(value)})
    chunks = training["chunks"]
    if chunks["regime"] == "window" and chunks.get("consecutive", 1) < Smoothness.span:
        batch = int(chunks["batch"])
        fitting = (size for size in range(Smoothness.span, batch + 1) if batch % size == 0)
        chunks["consecutive"] = next(fitting, Smoothness.span)


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


def apply(settings: Table, candidate: Candidate) -> Table:
    """Return settings with the values of a candidate.

    Raises:
        ConfigError: an unknown dimension.
    """
    changed_settings = copy.deepcopy(settings)
    # The order of the registry, whatever the order of the candidate: equal candidates give equal settings.
    for name in DIMENSIONS:  # depth after width, whatever the order of the candidate
        if name in candidate:
            DIMENSIONS[name](changed_settings, candidate[name])
    unknown = [name for name in candidate if name not in DIMENSIONS]
    if unknown:
        _ = DIMENSIONS[unknown[0]]
    return changed_settings


def applicable(space: Space, settings: Table) -> Space:
    """Return the dimensions that affect these settings: a pure LSTM has no kernel."""
    backbone = settings["model"]["backbone"]
    return {name: dimension for name, dimension in space.items() if name != "kernel" or "kernel" in backbone}


def halved(settings: Table) -> Table:
    """Return settings with the widths of the thesis's printed parameter counts (Tables B.1, 4.8 and 4.9).

    Channels start at C and halve from level to level. The hidden layers of a head are C / 2 wide where there is one of
    them and C / 4 where there are more. A pure TCN gets as many levels as its receptive field needs for the window
    (R >= W, thesis 3.2.3.2).
    """
    halved_settings = copy.deepcopy(settings)
    backbone, head = halved_settings["model"]["backbone"], halved_settings["model"]["head"]
    width = int(backbone.get("units", (backbone.get("channels") or [1])[0]))
    if "channels" in backbone:
        levels = len(backbone["channels"])
        while (
            backbone["kind"] == "tcn"
            and receptive_field(levels, backbone["kernel"]) < halved_settings["model"]["window"]
        ):
            if backbone["kernel"] < 2:
                break  # which sees one sample, however many levels there are
            levels += 1
        backbone["channels"] = [max(1, width >> level) for level in range(levels)]
    if hasattr(HEADS[head["kind"]], "hidden"):
        head["hidden"] = max(1, width // (2 if head.get("layers", 1) == 1 else 4))
    return halved_settings


WIDTHS: dict[str, Callable[[Table], Table]] = {"equal": lambda settings: settings, "halved": halved}
"""How widths follow from the hidden unit capacity: as they are, or as in the thesis."""


def elastic(space: Space, baseline: Candidate, reach: Mapping[str, float] = ELASTIC, beyond: bool = False) -> Space:
    """Return the window around a baseline for the tuning of candidates in phase 2; other dimensions are unchanged.

    Args:
        space: of phase 1.
        baseline: its values.
        reach: to both sides, by dimension.
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
    """Refuse a candidate that lacks a dimension of the space or lies outside it.

    Raises:
        ConfigError: with the value and the range.
    """
    for name, dimension in space.items():
        if name not in candidate:
            raise ConfigError(f"the candidate {dict(candidate)} has no value of '{name}'; {dimension} must hold it")
        if not dimension.holds(candidate[name]):
            raise ConfigError(
                f"{name} = {candidate[name]!r} is not in {dimension}; choose a value inside, or widen the space"
            )


def names(space: Space) -> Sequence[str]:
    """Dimensions in the order of the registry, so that a sampler always sees the same one; others behind, in theirs."""
    return [name for name in DIMENSIONS if name in space] + [name for name in space if name not in DIMENSIONS]
