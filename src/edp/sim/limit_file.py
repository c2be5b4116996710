"""Content of ``limit.json``: the limit of predictability of a simulated data set."""

from __future__ import annotations

from dataclasses import dataclass

from edp.errors import ConfigError
from edp.settings.bounds import check_bounds, integer, span
from edp.settings.results import ResultFile

Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, kw_only=True)
class LimitErrors:
    """Mean absolute errors with their interval.

    Each table has a row for each horizon, and a column for each target and for the mean over targets.

    Attributes:
        mae: mean absolute errors.
        low: lower ends of the intervals, from resampled recordings.
        high: upper ends of the intervals.
    """

    mae: Rows
    low: Rows
    high: Rows


@dataclass(frozen=True, kw_only=True)
class LimitFile(ResultFile):
    """Content of ``limit.json``.

    Attributes:
        unit: unit of the errors.
        rate_hz: sample rate.
        horizons: horizons in samples.
        targets: names of the predicted channels.
        confidence: level of the intervals.
        moments: number of branching times per recording.
        branches: number of simulated futures per branching time.
        recordings: number of recordings.
        seed: root of the random futures.
        commands_unknown: errors of a predictor that knows the state but not the future commands.
        commands_known: errors of a predictor that knows the state and the future commands.
        persistence: errors of the present value as prediction.
        key: hash of the data set and of the settings; None without a data set on disk.

    Raises:
        ConfigError: a number is out of range, or a table has another shape.
    """

    NAME = "limit.json"
    SCHEMA = 1
    WHAT = "limit of predictability"
    ADVICE = "remove it and run edp simulate --limit"

    unit: str
    rate_hz: float
    horizons: tuple[int, ...]
    targets: tuple[str, ...]
    confidence: float
    moments: int
    branches: int
    recordings: int
    seed: int
    commands_unknown: LimitErrors
    commands_known: LimitErrors
    persistence: LimitErrors
    key: str | None = None

    def __post_init__(self) -> None:
        check_bounds("limit", self, rate_hz=span(1e-9, 1e9), horizons=integer(0, 10**9))
        shape = len(self.horizons), len(self.targets) + 1
        for name in ("commands_unknown", "commands_known", "persistence"):
            errors = getattr(self, name)
            for table in (errors.mae, errors.low, errors.high):
                if len(table) != shape[0] or any(len(row) != shape[1] for row in table):
                    raise ConfigError(f"limit: {name} must have {shape[0]} rows of {shape[1]} numbers")
