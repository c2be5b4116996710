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
    source_arrays,
    texts_of,
)
from edp.monitor.residuals.committees import constant_channels
from edp.settings.bounds import check_bounds, span
from edp.storage.arrays import POSITIVE, ArrayRule
from edp.wording import figure, setting_text

Array = NDArray[np.float64]
ARRAYS = {
    "template": ArrayRule(("ticks", "inputs"), np.float32),
    "width": ArrayRule(("ticks", "inputs"), np.float32, low=POSITIVE),
}
"""Arrays of the source in the monitor file, with their rules."""
PREFIX = "cycle:"
MIN_CYCLES = 3
"""Minimum number of cycles. Fewer cycles do not show the scatter."""
MOST_TICKS = 1_000_000
"""Maximum length of a cycle in samples."""
UNEVEN = 0.01
"""Maximum deviation of a cycle from a whole number of samples. A deviation of 0.01 becomes one sample after a hundred
cycles.
"""
NARROWEST = 1e-3
"""Minimum scatter at a position of the cycle, relative to the total variation of the channel."""


class Cycles(ResidualSource):
    """Measured less the mean of healthy cycles at the same tick of the cycle, over the scatter of those there.

    A stream begins at the start of a cycle. Where cycles repeat, each follows the one before without a gap; else the
    stream is one cycle, and what comes behind it is not evaluated.

    Args:
        inputs: channels, SI units.
        template: mean of healthy cycles, shape (ticks, inputs).
        width: their scatter, above zero, shape (ticks, inputs).
        middle: mean of each input on healthy sessions.
        repeats: whether a cycle follows the one before.
    """

    def __init__(self, inputs: Sequence[str], template: Rows, width: Rows, middle: Rows, repeats: bool = True) -> None:
        self.repeats = repeats
        self.inputs, self.middle = tuple(inputs), np.asarray(middle, np.float32)
        self.template, self.width = np.asarray(template, np.float32), np.asarray(width, np.float32)
        self.names = tuple(PREFIX + name for name in self.inputs)
        self.judged = self.reads = tuple((name,) for name in self.inputs)
        self.units = ("1",) * len(self.inputs)

    def _start(self, streams: int) -> Any:
        return 0

    def _run(self, rows: Rows, there: NDArray[np.bool_], own: Any) -> tuple[Rows, Any]:
        ticks = len(self.template)
        tick_index = own + np.arange(rows.shape[1])
        at = tick_index % ticks
        residuals = (rows - self.template[at]) / self.width[at]
        if not self.repeats:
            residuals[:, tick_index >= ticks] = np.nan
        after = own + rows.shape[1]
        return residuals, after % ticks if self.repeats else min(after, ticks)

    def parts(self) -> SourceParts:
        """See `ResidualSource.parts`."""
        arrays = {"template": self.template, "width": self.width, "middle": self.middle}
        return SourceParts({"inputs": list(self.inputs), "repeats": self.repeats}, arrays)

    @classmethod
    def from_parts(cls, parts: SourceParts) -> Cycles:
        """See `ResidualSource.from_parts`."""
        inputs, arrays = texts_of(parts.plain["inputs"], "its inputs"), source_arrays(parts, ARRAYS)
        repeats = parts.plain["repeats"]
        if type(repeats) is not bool:
            raise ValueError("it does not say whether its cycle repeats")
        if not 1 <= len(arrays["template"]) <= MOST_TICKS:
            raise ValueError(f"a cycle has {len(arrays['template'])} ticks; 1 to {MOST_TICKS} must hold")
        return cls(inputs, arrays["template"], arrays["width"], arrays["middle"], repeats)


@RESIDUALS.register("cycles")
@dataclass(frozen=True, kw_only=True)
class CyclesSpec(ResidualSpec):
    """Each channel at its place in a cycle that the machine repeats.

    Attributes:
        period_s: length of a cycle, s, a whole number of samples. Logs begin with a cycle and consist of consecutive
            cycles. 0: each log is one cycle of the length of the shortest log; later samples are not evaluated.

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
            DataError: too few cycles, or one that is too long or no whole number of ticks.
        """
        material.progress.note("cycles")
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
        return Cycles(inputs, template, width, mean_inputs(material, inputs), bool(self.period_s))

    def _cycles(self, material: FitMaterial, inputs: Sequence[str]) -> Array:
        """Return all whole cycles of the healthy logs, shape (cycles, ticks, inputs)."""
        logs = (*material.train, *material.validation)
        exact = self.period_s * material.rate_hz if self.period_s else float(min(log.samples for log in logs))
        ticks = round(exact)
        if not 1 <= ticks <= MOST_TICKS or abs(exact - ticks) > UNEVEN:
            raise DataError(
                f"cycles: period_s = {setting_text(self.period_s)} is {figure(exact)} ticks of "
                f"{figure(material.rate_hz)} Hz; a whole number "
                f"of 1 to {MOST_TICKS} must hold, since each cycle begins at a tick"
            )
        whole = [log.samples // ticks if self.period_s else 1 for log in logs]
        if sum(whole) < MIN_CYCLES:
            raise DataError(
                f"cycles: {sum(whole)} cycles of {figure(ticks / material.rate_hz)} s are in the healthy logs that "
                "train; "
                f"{MIN_CYCLES} at least must hold: bring more logs, or give the length of a cycle as period_s"
            )
        parts = [
            log.select(inputs)[: count * ticks].reshape(count, ticks, len(inputs))
            for log, count in zip(logs, whole, strict=True)
        ]
        return np.concatenate(parts).astype(np.float64)
