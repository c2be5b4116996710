"""Network outputs per target: a point, quantiles or an error distribution; and calibrated intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from edp.errors import ConfigError, ExportError
from edp.ir import Builder
from edp.ir.layers import Accumulate, Activate, BinaryOperation, Function, ScaleShift
from edp.networks.losses import Prediction
from edp.networks.streaming import Operation
from edp.registry import Registry
from edp.settings.bounds import between, check_bounds, check_count
from edp.wording import typed

SMALLEST = 1e-4  # least distance of neighbouring quantiles, in standard deviations of the target
LOW_LOG_VARIANCE = 2.0 * math.log(1e-3)


class OutputSpec(Protocol):
    """Options of an output."""

    @property
    def values(self) -> int:
        """Numbers that the heads give for each horizon and target; the first is the prediction."""
        ...

    @property
    def coverages(self) -> tuple[float, ...]:
        """Intended fractions of the targets within the intervals, the widest interval first."""
        ...

    @property
    def calibrated(self) -> bool:
        """Whether training ends with a calibration of the intervals."""
        ...

    def build(self, horizons: int, outputs: int) -> Output:
        """Build the output layer."""
        ...


OUTPUTS: Registry[type] = Registry("output")
MAX_PAIRS = 99
"""Maximum number of quantiles or intervals: one per whole per cent."""


class Output(nn.Module):
    """Interpretation of the additional head outputs as intervals; this class has point predictions only.

    Args:
        coverages: coverages of its intervals.
        horizons: number of horizons.
        outputs: number of targets.
    """

    operations: frozenset[Operation] = frozenset()
    stretch: Tensor

    def __init__(self, coverages: Sequence[float], horizons: int, outputs: int) -> None:
        super().__init__()
        self.coverages = tuple(coverages)
        if self.coverages:
            # Factors of the distances from the centre, set by calibration.
            self.register_buffer("stretch", torch.ones(len(self.coverages), horizons, outputs))

    def answer(self, center: Tensor, raw: Tensor) -> Prediction:
        """Return the network output from the prediction and the additional head outputs ``(..., number, output)``."""
        return Prediction(center, raw)

    def reach(self, answer: Prediction, which: int) -> tuple[Tensor, Tensor]:
        """Return the distances of the bounds of interval `which` below and above the centre, before calibration."""
        raise ConfigError("a point output has no intervals; train with model.output kind 'quantiles' or 'normal'")

    def interval(self, answer: Prediction, which: int) -> tuple[Tensor, Tensor]:
        """Lower and upper bound of interval `which`, standardised, ``(..., horizon, output)``."""
        below, above = self.reach(answer, which)
        return answer.center - self.stretch[which] * below, answer.center + self.stretch[which] * above

    def lower(self, build: Builder, center: str, y: str) -> tuple[str, str] | None:
        """Add lower and upper bounds, ``coverage * horizon * output`` standardised elements each; None for a point.

        Args:
            build: builder of the layer graph.
            center: the prediction, ``horizon * output``.
            y: output of the heads, ``horizon * value * output``.
        """
        if not self.coverages:
            return None
        with build.inside("interval"):
            below, above = self.lower_reach(build, y)
            stretch = self.stretch.flatten()
            centers = build.pick("center", center, list(range(build.width(center))) * len(self.coverages))
            zeros = torch.zeros_like(stretch)
            down = build.add(ScaleShift, "below", below, gain=stretch, shift=zeros)
            up = down if above == below else build.add(ScaleShift, "above", above, gain=stretch, shift=zeros)
            lower = build.combine("lower", BinaryOperation.SUBTRACT, centers, down)
            return lower, build.combine("upper", BinaryOperation.ADD, centers, up)

    def lower_reach(self, build: Builder, y: str) -> tuple[str, str]:
        """Add `reach` of all coverages as layers, ``coverage * horizon * output`` elements below and above."""
        raise ExportError(f"the output '{type(self).__name__}' has no form as a list of streaming layers")

    def rows(self, values: int, numbers: Sequence[int]) -> list[int]:
        """Return the positions of `numbers` among `values` head outputs, in the order ``number, horizon, output``."""
        _, horizons, outputs = self.stretch.shape
        return [(h * values + v) * outputs + c for v in numbers for h in range(horizons) for c in range(outputs)]

    def place(self, coverage: float) -> int:
        """Return the index of the interval with this coverage.

        Raises:
            ConfigError: no interval has this coverage.
        """
        for which, own_coverage in enumerate(self.coverages):
            if math.isclose(own_coverage, coverage, abs_tol=1e-6):
                return which
        if not self.coverages:
            raise ConfigError("a point output has no intervals; train with model.output kind 'quantiles' or 'normal'")
        listed = ", ".join(typed(own_coverage) for own_coverage in self.coverages)
        raise ConfigError(f"there is no interval of coverage {typed(coverage)}; this network has {listed}")

    def calibrate(self, answer: Prediction, target: Tensor) -> None:
        """Scale each interval so that it contains its fraction of these targets (split conformal, multiplicative).

        The factor is the ``(n + 1) c / n`` quantile of the error in units of the distance to the bound on its side.

        Args:
            answer: outputs for n samples not used in training, ``(1, tick, horizon, output)`` etc.
            target: standardised, ``(1, tick, horizon, output)``.
        """
        error = target - answer.center
        for which, coverage in enumerate(self.coverages):
            below, above = self.reach(answer, which)
            ratio = (error / torch.where(error < 0, -below, above)).flatten(0, 1)
            rank = min(len(ratio), math.ceil((len(ratio) + 1) * coverage))
            self.stretch[which] = ratio.kthvalue(rank, dim=0).values.to(self.stretch)


@OUTPUTS.register("point")
@dataclass(frozen=True, kw_only=True)
class Point:
    """One number for each horizon and target."""

    @property
    def values(self) -> int:
        """The prediction alone."""
        return 1

    @property
    def coverages(self) -> tuple[float, ...]:
        """No intervals."""
        return ()

    @property
    def calibrated(self) -> bool:
        """Return False, since a point has no intervals to calibrate."""
        return False

    def build(self, horizons: int, outputs: int) -> Output:
        """Build a layer that returns the prediction unchanged."""
        return Output((), horizons, outputs)


@OUTPUTS.register("quantiles")
@dataclass(frozen=True, kw_only=True)
class Quantiles:
    """Quantiles that cannot cross: the median, and sums of positive gaps ``softplus(.)`` above and below it.

    The prediction is the median. Levels that mirror each other, such as 0.05 and 0.95, are the bounds of an interval.

    Attributes:
        levels: increasing, between 0 and 1, symmetric about the median 0.5.
        calibrated: whether the intervals are scaled after training, so that they contain their fraction of the
            validation data.

    Raises:
        ConfigError: levels that are not as said.
    """

    levels: tuple[float, ...] = (0.05, 0.25, 0.5, 0.75, 0.95)
    calibrated: bool = True

    def __post_init__(self) -> None:
        check_count("quantiles", "levels", self.levels, MAX_PAIRS)
        check_bounds("quantiles", self, levels=between(0.0, 1.0))
        mirrored = [1.0 - level for level in reversed(self.levels)]
        symmetric = all(math.isclose(a, b, abs_tol=1e-9) for a, b in zip(self.levels, mirrored, strict=True))
        rising = list(self.levels) == sorted(set(self.levels))
        if len(self.levels) < 3 or not symmetric or not rising or not min(self.levels) > 0 or 0.5 not in self.levels:
            raise ConfigError(
                f"quantiles: levels = {list(self.levels)}; increasing, between 0 and 1, symmetric about 0.5 and with "
                "0.5 among them must hold, for example [0.05, 0.5, 0.95]"
            )

    @property
    def values(self) -> int:
        """Number of raw outputs per target (one per quantile level)."""
        return len(self.levels)

    @property
    def coverages(self) -> tuple[float, ...]:
        """Coverages of the pairs of mirrored levels."""
        return tuple(round(1.0 - 2.0 * level, 9) for level in self.levels if level < 0.5)

    def build(self, horizons: int, outputs: int) -> Output:
        """Build a layer with ordered quantiles."""
        return _Quantiles(self, horizons, outputs)


class _Quantiles(Output):
    operations = frozenset({Operation.SOFTPLUS})

    def __init__(self, spec: Quantiles, horizons: int, outputs: int) -> None:
        super().__init__(spec.coverages, horizons, outputs)
        self.pairs = len(spec.levels) // 2
        self.levels = tuple(level for level in spec.levels if level != 0.5)

    def answer(self, center: Tensor, raw: Tensor) -> Prediction:
        gaps = functional.softplus(raw) + SMALLEST
        below = -gaps[..., : self.pairs, :].cumsum(dim=-2).flip(-2)
        above = gaps[..., self.pairs :, :].cumsum(dim=-2)
        return Prediction(center, torch.cat([below, above], dim=-2), levels=self.levels)

    def reach(self, answer: Prediction, which: int) -> tuple[Tensor, Tensor]:
        return -answer.spread[..., which, :], answer.spread[..., -1 - which, :]

    def lower_reach(self, build: Builder, y: str) -> tuple[str, str]:
        pairs, (_, horizons, outputs) = self.pairs, self.stretch.shape
        size = horizons * outputs
        ones, bounds = torch.ones(pairs * size), []
        for side, first in (("down", 1), ("up", 1 + pairs)):
            raw = build.pick(side, y, self.rows(1 + 2 * pairs, range(first, first + pairs)))
            gap = build.add(Activate, f"{side}_softplus", raw, function=Function.SOFTPLUS, size=pairs * size)
            gap = build.add(ScaleShift, f"{side}_gap", gap, gain=ones, shift=SMALLEST * ones)
            total = build.add(Accumulate, f"{side}_total", gap, rows=pairs, size=size)
            widest_first = [row * size + i for row in reversed(range(pairs)) for i in range(size)]
            bounds.append(build.pick(f"{side}_ordered", total, widest_first))
        return bounds[0], bounds[1]


@dataclass(frozen=True, kw_only=True)
class _Law:
    """Options of an output that states the variance of its error.

    Attributes:
        coverages: coverages of the calibrated and evaluated intervals, decreasing.
        calibrated: whether the intervals are scaled after training, so that they contain their fraction of the
            validation data.

    Raises:
        ConfigError: coverages that are not decreasing between 1 and 0.
    """

    coverages: tuple[float, ...] = (0.9, 0.5)
    calibrated: bool = True

    def __post_init__(self) -> None:
        check_count("output", "coverages", self.coverages, MAX_PAIRS, least=1)
        check_bounds("output", self, coverages=between(0.0, 1.0))
        falling = list(self.coverages) == sorted(set(self.coverages), reverse=True)
        if not self.coverages or not falling or not 0 < min(self.coverages) <= max(self.coverages) < 1:
            raise ConfigError(
                f"output: coverages = {list(self.coverages)}; decreasing, between 1 and 0, at least one must hold"
            )

    @property
    def values(self) -> int:
        """The mean and the logarithm of the variance."""
        return 2


@OUTPUTS.register("normal")
@dataclass(frozen=True, kw_only=True)
class Normal(_Law):
    """The mean and the variance of a normal law."""

    def build(self, horizons: int, outputs: int) -> Output:
        """Build a layer with a bounded log variance."""
        # The standard library's law, not a tensor's: sizes are asked for on a device without numbers, too.
        sizes = [NormalDist().inv_cdf((1.0 + c) / 2.0) for c in self.coverages]
        return _Spread("normal", self.coverages, sizes, (horizons, outputs))


@OUTPUTS.register("laplace")
@dataclass(frozen=True, kw_only=True)
class Laplace(_Law):
    """Mean and variance of a Laplace distribution, which has heavier tails than a normal distribution."""

    def build(self, horizons: int, outputs: int) -> Output:
        """Build a layer with a bounded log variance."""
        return _Spread(
            "laplace", self.coverages, [-math.log1p(-c) / math.sqrt(2.0) for c in self.coverages], (horizons, outputs)
        )


class _Spread(Output):
    """Intervals of `sizes` standard deviations to each side."""

    operations = frozenset({Operation.SOFTPLUS})

    def __init__(self, law: str, coverages: Sequence[float], sizes: Sequence[float], shape: tuple[int, int]) -> None:
        super().__init__(coverages, *shape)
        self.law, self.sizes = law, tuple(sizes)

    def answer(self, center: Tensor, raw: Tensor) -> Prediction:
        log_variance = LOW_LOG_VARIANCE + functional.softplus(raw - LOW_LOG_VARIANCE)
        return Prediction(center, log_variance, law=self.law)

    def reach(self, answer: Prediction, which: int) -> tuple[Tensor, Tensor]:
        distance = self.sizes[which] * torch.exp(0.5 * answer.spread[..., 0, :])
        return distance, distance

    def lower_reach(self, build: Builder, y: str) -> tuple[str, str]:
        ones = torch.ones(self.stretch[0].numel())
        size, low = len(ones), LOW_LOG_VARIANCE
        raw = build.pick("raw", y, self.rows(2, [1]))
        raised = build.add(ScaleShift, "raised", raw, gain=ones, shift=-low * ones)
        soft = build.add(Activate, "softplus", raised, function=Function.SOFTPLUS, size=size)
        half = build.add(ScaleShift, "half", soft, gain=0.5 * ones, shift=0.5 * low * ones)
        sigma = build.add(Activate, "sigma", half, function=Function.EXP, size=size)
        every = build.pick("repeated", sigma, list(range(size)) * len(self.sizes))
        gain = torch.tensor(self.sizes).repeat_interleave(size)
        distance = build.add(ScaleShift, "distance", every, gain=gain, shift=torch.zeros_like(gain))
        return distance, distance
