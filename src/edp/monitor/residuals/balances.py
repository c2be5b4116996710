"""Physical balances: position minus integrated velocity, velocity minus integrated acceleration.

What stores heat has no rate that is measured, but it cannot jump: a temperature is compared with itself some time ago.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from edp.monitor.residuals.base import (
    RESIDUALS,
    FitMaterial,
    ResidualSource,
    ResidualSpec,
    Rows,
    SourceParts,
    mean_inputs,
    residual_labels,
    source_arrays,
)
from edp.recording import Recording
from edp.settings.bounds import above, check_bounds, span
from edp.signals import KINDS, Channel, Kind
from edp.storage.arrays import ArrayRule

Array = NDArray[np.float64]
ARRAYS = {
    "pairs": ArrayRule(("residuals", 2), np.int64, low=0, high="inputs"),
    "gains": ArrayRule(("residuals",)),
    "memories_s": ArrayRule(("residuals",)),
}
"""Arrays of the source in the monitor file, with their rules."""
RATE_OF = {
    Kind.POSITION: Kind.VELOCITY,
    Kind.ANGLE: Kind.ANGULAR_VELOCITY,
    Kind.VELOCITY: Kind.ACCELERATION,
}
"""Kind of the time derivative of each kind of channel."""
SLOW = (Kind.TEMPERATURE,)
"""Kinds that change slowly. Their rate of change is assumed to be zero."""
MATCH_S = 0.5
"""Interval over which changes are compared to match a rate channel with a level channel, s."""
MAX_ROWS = 200_000
"""Maximum number of rows for this comparison: half an hour at 100 Hz."""


class Balances(ResidualSource):
    """Levels minus the integrals of their rates, with an exponential memory of `memory_s`.

    With d[t] = x[t] - x[t-1] - gain v[t] dt the residual is e[t] = left e[t-1] + d[t], left = 1 - dt / memory_s: a
    leaky sum has no drift, and a step of the level stays visible for `memory_s`. At a tick at which level or rate is
    missing, or the level was missing at the tick before, d is 0: what happened meanwhile is not known. A level that
    cannot jump has no rate: itself stands in its place, with a gain of zero.

    Args:
        inputs: raw channels, SI units.
        pairs: places of level and rate among the inputs, one a residual, shape (residuals, 2).
        gains: gain of each rate.
        memories_s: memory of each residual, s.
        rate_hz: sampling rate in Hz.
        middle: mean of each input on healthy sessions.
        units: SI unit of each residual.
    """

    def __init__(
        self,
        inputs: Sequence[str],
        pairs: NDArray[np.int64],
        gains: Array,
        memories_s: Array,
        rate_hz: float,
        middle: Rows,
        units: Sequence[str],
    ) -> None:
        self.inputs, self.units = tuple(inputs), tuple(units)
        self.pairs, self.gains, self.memories_s, self.rate_hz = pairs, gains, memories_s, rate_hz
        self.middle = np.asarray(middle, np.float32)
        both = [(self.inputs[level], self.inputs[rate]) for level, rate in pairs.tolist()]
        self.names = tuple(
            f"balance:{level if level == rate else f'{level}-{rate}'}:{memory:g}s"
            for (level, rate), memory in zip(both, memories_s, strict=True)
        )
        self.judged = self.reads = tuple(tuple(dict.fromkeys(pair)) for pair in both)

    def _start(self, streams: int) -> Any:
        # None until the first tick, which has no change.
        none = np.zeros((streams, len(self.names)))
        return None, none, none.astype(bool)

    def _run(self, rows: Rows, there: NDArray[np.bool_], own: Any) -> tuple[Rows, Any]:
        before, residual, there_before = own
        levels = rows[..., self.pairs[:, 0]].astype(np.float64)
        rates = rows[..., self.pairs[:, 1]].astype(np.float64)
        first = before is None
        before = levels[:, 0] if first else before
        steps = rates * (self.gains / self.rate_hz)
        if first:
            steps[:, 0] = 0.0
        change = np.diff(levels, axis=1, prepend=before[:, None]) - steps
        measured = there[..., self.pairs[:, 0]]
        earlier = np.concatenate([(measured[:, 0] if first else there_before)[:, None], measured[:, :-1]], axis=1)
        change[~(measured & earlier & there[..., self.pairs[:, 1]])] = 0.0
        out = np.empty(change.shape)
        left = 1.0 - 1.0 / (self.memories_s * self.rate_hz)
        for column, share in enumerate(left.tolist()):
            start = share * residual[:, column : column + 1]
            out[..., column], _ = lfilter([1.0], [1.0, -share], change[..., column], axis=1, zi=start)
        return out.astype(np.float32), (levels[:, -1], out[:, -1], measured[:, -1])

    def parts(self) -> SourceParts:
        """See `ResidualSource.parts`."""
        plain = {"inputs": list(self.inputs), "units": list(self.units), "rate_hz": self.rate_hz}
        arrays: dict[str, NDArray[Any]] = {
            "pairs": self.pairs,
            "gains": self.gains,
            "memories_s": self.memories_s,
            "middle": self.middle,
        }
        return SourceParts(plain, arrays)

    @classmethod
    def from_parts(cls, parts: SourceParts) -> Balances:
        """See `ResidualSource.from_parts`."""
        inputs, units = residual_labels(parts.plain)
        arrays, rate_hz = source_arrays(parts, ARRAYS, residuals=len(units)), float(parts.plain["rate_hz"])
        if not 0.0 < rate_hz <= 1e6:
            raise ValueError(f"the rate of a balance is {rate_hz} Hz; above 0 and at most 1e6 must hold")
        if (arrays["memories_s"] * rate_hz < 1.0).any():
            raise ValueError("the memory of a balance is shorter than a tick")
        return cls(inputs, **arrays, rate_hz=rate_hz, units=units)


@RESIDUALS.register("balances")
@dataclass(frozen=True, kw_only=True)
class BalancesSpec(ResidualSpec):
    """Levels against the integrals of their rates.

    Attributes:
        memory_s: times after which the residual of a position has faded.
        rate_memory_s: memory of a velocity compared with its acceleration, s.
        slow_memory_s: memory of a temperature compared with itself, s.
        match: correlation of changes, above which a rate belongs to a level.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    source: ClassVar[type[ResidualSource]] = Balances
    memory_s: tuple[float, ...] = (0.5, 3.0, 30.0)
    rate_memory_s: tuple[float, ...] = (0.5,)
    slow_memory_s: tuple[float, ...] = (10.0,)
    match: float = 0.8

    def __post_init__(self) -> None:
        for name in ("memory_s", "rate_memory_s", "slow_memory_s"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        times = dict.fromkeys(("memory_s", "rate_memory_s", "slow_memory_s"), above(0.0, 3600.0))
        check_bounds("balances", self, match=span(0.0, 1.0), **times)

    def fit(self, material: FitMaterial) -> ResidualSource | None:
        """See `ResidualSpec.fit`."""
        material.progress.note("balances")
        matches = [
            (level, rate, gain, max(memory, 2.0 / material.rate_hz))
            for level, rate, gain in match_pairs(material.channels, material.train, material.rate_hz, self.match)
            for memory in (self.rate_memory_s if level.kind is Kind.VELOCITY else self.memory_s)
        ]
        matches += [
            (slow, slow, 0.0, max(memory, 2.0 / material.rate_hz))
            for slow in slow_channels(material.channels, material.train)
            for memory in self.slow_memory_s
        ]
        if not matches:
            return None
        used = {channel.name for level, rate, _, _ in matches for channel in (level, rate)}
        inputs = tuple(name for name in material.names if name in used)
        pairs = np.array([[inputs.index(level.name), inputs.index(rate.name)] for level, rate, _, _ in matches])
        gains, memories = (np.array([entry[index] for entry in matches]) for index in (2, 3))
        units = [KINDS[level.kind].si_unit for level, _, _, _ in matches]
        return Balances(inputs, pairs, gains, memories, material.rate_hz, mean_inputs(material, inputs), units)


def slow_channels(channels: Sequence[Channel], sessions: Sequence[Recording]) -> list[Channel]:
    """Return channels that cannot jump and are not constant."""
    return [
        channel
        for channel in channels
        if channel.kind in SLOW and any(np.ptp(session.column(channel.name)) > 0.0 for session in sessions)
    ]


def match_pairs(
    channels: Sequence[Channel], sessions: Sequence[Recording], rate_hz: float, least: float
) -> list[tuple[Channel, Channel, float]]:
    """Return the levels with the rates that belong to them: the best match of each level, with the gain of the rate."""
    ticks = max(1, round(MATCH_S * rate_hz))
    pairs = []
    for kind, rate_kind in RATE_OF.items():
        levels = [channel for channel in channels if channel.kind is kind]
        rates = [channel for channel in channels if channel.kind is rate_kind]
        scored = [
            (*_match(level.name, rate.name, sessions, ticks, rate_hz), level, rate)
            for level, rate in itertools.product(levels, rates)
        ]
        for level in levels:
            best = max((entry for entry in scored if entry[2] is level), key=lambda entry: entry[0], default=None)
            if best is not None and best[0] >= least:
                pairs.append((level, best[3], best[1]))
    return pairs


def _match(level: str, rate: str, sessions: Sequence[Recording], ticks: int, rate_hz: float) -> tuple[float, float]:
    """Return the correlation of the changes of a level with the integral of a rate, and the gain of the latter."""
    xy = xx = yy = 0.0
    rows = 0
    for session in sessions:
        if rows > MAX_ROWS or session.samples <= ticks:
            continue
        x = session.column(level).astype(np.float64)
        y = np.cumsum(session.column(rate).astype(np.float64)) / rate_hz
        dx, dy = x[ticks:] - x[:-ticks], y[ticks:] - y[:-ticks]
        fine = np.isfinite(dx) & np.isfinite(dy)
        xy, xx, yy = xy + float(dx[fine] @ dy[fine]), xx + float(dx[fine] @ dx[fine]), yy + float(dy[fine] @ dy[fine])
        rows += len(dx)
    if xx <= 0.0 or yy <= 0.0:
        return 0.0, 0.0
    return xy / float(np.sqrt(xx * yy)), xy / yy
