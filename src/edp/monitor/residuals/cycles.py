"""Machines that repeat a cycle: each channel against what healthy cycles showed at the same place of the cycle.

Where work repeats, a valve that switches late shows in the tick behind its command and in no other, and is lost in
means over seconds. No other channel is asked, so a disturbance that all channels share is seen, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.monitor.residuals.base import (
    RESIDUALS,
    FitMaterial,
    ResidualSource,
    ResidualSpec,
    Rows,
    SourceParts,
    mean_inputs,
    middle_of,
)
from edp.monitor.residuals.committees import constant_channels
from edp.settings.bounds import check_bounds, span

Array = NDArray[np.float64]
PREFIX = "cycle:"
LEAST_CYCLES = 3
"""Fewer tell no scatter."""
MOST_TICKS = 1_000_000
"""Of a cycle."""
NARROWEST = 1e-3
"""Least scatter at a place of the cycle, over how widely the channel varies in all."""


class Cycles(ResidualSource):
    """Measured less the mean of healthy cycles at the same tick of the cycle, over the scatter of those there.

    A stream begins at the start of a cycle, and each cycle follows the one before without a gap.

    Args:
        inputs: channels, SI units.
        template: mean of healthy cycles, shape (ticks, inputs).
        width: their scatter, above zero, shape (ticks, inputs).
        middle: mean of each input on healthy sessions.
    """

    def __init__(self, inputs: Sequence[str], template: Rows, width: Rows, middle: Rows) -> None:
        self.inputs, self.middle = tuple(inputs), np.asarray(middle, np.float32)
        self.template, self.width = np.asarray(template, np.float32), np.asarray(width, np.float32)
        self.names = tuple(PREFIX + name for name in self.inputs)
        self.judged = self.reads = tuple((name,) for name in self.inputs)
        self.units = ("1",) * len(self.inputs)

    def _start(self, streams: int) -> Any:
        return 0

    def _run(self, rows: Rows, there: NDArray[np.bool_], own: Any) -> tuple[Rows, Any]:
        at = (own + np.arange(rows.shape[1])) % len(self.template)
        residuals = (rows - self.template[at]) / self.width[at]
        return residuals, (own + rows.shape[1]) % len(self.template)

    def parts(self) -> SourceParts:
        """See `ResidualSource.parts`."""
        arrays = {"template": self.template, "width": self.width, "middle": self.middle}
        return SourceParts({"inputs": list(self.inputs)}, arrays)

    @classmethod
    def of_parts(cls, parts: SourceParts) -> Cycles:
        """See `ResidualSource.of_parts`."""
        inputs, middle = middle_of(parts)
        template, width = (np.asarray(parts.arrays[name], np.float32) for name in ("template", "width"))
        if template.ndim != 2 or template.shape != width.shape or template.shape[1] != len(inputs):
            raise ValueError("arrays of a cycle have other shapes than its header says")
        if not 1 <= len(template) <= MOST_TICKS:
            raise ValueError(f"a cycle has {len(template)} ticks; 1 to {MOST_TICKS} must hold")
        if not (np.isfinite(template).all() and np.isfinite(width).all() and (width > 0.0).all()):
            raise ValueError("a number of a cycle is not finite, or a width is not above zero")
        return cls(inputs, template, width, middle)


@RESIDUALS.register("cycles")
@dataclass(frozen=True, kw_only=True)
class CyclesSpec(ResidualSpec):
    """Each channel at its place in a cycle that the machine repeats.

    Attributes:
        period_s: of a cycle, s; logs begin with one, and hold one after the other. 0: each log is one cycle, as long as
            the shortest one.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    source: ClassVar[type[ResidualSource]] = Cycles
    period_s: float = 0.0

    def __post_init__(self) -> None:
        check_bounds("cycles", self, period_s=span(0.0, 1e6))

    def fit(self, material: FitMaterial) -> ResidualSource | None:
        """See `ResidualSpec.fit`.

        Raises:
            DataError: too few cycles, or one that is too long.
        """
        material.note("cycles")
        constant = constant_channels(material)
        inputs = tuple(name for name in material.names if name not in constant)
        if not inputs:
            return None
        cycles = self._cycles(material, inputs)
        template, scatter = cycles.mean(axis=0), cycles.std(axis=0, ddof=1)
        # Few cycles tell the scatter of a single tick badly: half of it is that of the whole channel.
        pooled = np.sqrt(np.square(scatter).mean(axis=0))
        least = NARROWEST * cycles.std(axis=(0, 1))
        width = np.maximum(np.sqrt(0.5 * (np.square(scatter) + np.square(pooled))), least)
        return Cycles(inputs, template, width, mean_inputs(material, inputs))

    def _cycles(self, material: FitMaterial, inputs: Sequence[str]) -> Array:
        """All whole cycles of the healthy logs, shape (cycles, ticks, inputs)."""
        logs = (*material.train, *material.validation)
        ticks = round(self.period_s * material.rate_hz) or min(log.samples for log in logs)
        if ticks > MOST_TICKS:
            raise DataError(f"cycles: period_s = {self.period_s:g} is {ticks} ticks; at most {MOST_TICKS} must hold")
        whole = [log.samples // ticks if self.period_s else 1 for log in logs]
        if sum(whole) < LEAST_CYCLES:
            raise DataError(
                f"cycles: {sum(whole)} cycles of {ticks / material.rate_hz:g} s are in the healthy logs that train; "
                f"{LEAST_CYCLES} at least must hold: bring more logs, or give the length of a cycle as period_s"
            )
        parts = [
            log.select(inputs)[: count * ticks].reshape(count, ticks, len(inputs))
            for log, count in zip(logs, whole, strict=True)
        ]
        return np.concatenate(parts).astype(np.float64)
