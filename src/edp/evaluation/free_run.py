"""Scores of a twin: free runs on commands alone from measured starts, against what was measured meanwhile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.errors import DataError
from edp.networks.twin import Twin, even_starts
from edp.settings.bounds import MOST_BATCH, MOST_NAMES, above, check_bounds, check_count, whole
from edp.signals import KINDS, Channel

Array = NDArray[np.float32]
MOST_SECONDS = 86_400.0
"""Of a free run: a day."""
ASTRAY = 0.5
"""Share of a stroke's range; a run whose stroke is further off than that counts as diverged."""
LANES = 64
"""Free runs side by side: all of a data set at once would need memory without bound."""


@dataclass(frozen=True, kw_only=True)
class FreeRunJudgeSpec:
    """How a twin is judged.

    Attributes:
        seconds: length of a free run; cut to what the longest recording has.
        starts: free runs in each recording, evenly spread.
        at_s: times after the start at which strokes are compared.
        floors: formulations that are fitted to the same recordings and judged beside it.

    Raises:
        ConfigError: a value out of range.
    """

    seconds: float = 60.0
    starts: int = 4
    at_s: tuple[float, ...] = (1.0, 5.0, 10.0, 30.0, 60.0)
    floors: tuple[str, ...] = ("static", "arx")

    def __post_init__(self) -> None:
        length = above(0.0, MOST_SECONDS)
        check_bounds("judge", self, seconds=length, at_s=length, starts=whole(1, MOST_BATCH))
        check_count("judge", "at_s", self.at_s, MOST_NAMES, least=1)
        check_count("judge", "floors", self.floors, MOST_NAMES)


@dataclass(frozen=True, eq=False)
class FreeRuns:
    """Free runs and what was measured meanwhile.

    Attributes:
        channels: of the twin.
        names: recording of each run.
        answers: ``(run, tick, answer)``, SI units; row t is tick t + 1 of the free run.
        truth: measured, of the same shape.
        before: measured at the last tick before the first answer ``(run, answer)``.
        stroke_range: from end stop to end stop ``(stroke,)``, SI units; empty without strokes.
    """

    channels: TwinChannels
    names: tuple[str, ...]
    answers: Array
    truth: Array
    before: Array
    stroke_range: Array

    @property
    def stroke_errors(self) -> NDArray[np.float64]:
        """Absolute errors of the strokes ``(run, tick, velocity)``, SI units; without strokes of integrals."""
        count = len(self.channels.velocities)
        if self.channels.strokes:
            return np.abs(self.answers[..., count : 2 * count].astype(np.float64) - self.truth[..., count : 2 * count])
        return np.abs(self._integral(self.answers) - self._integral(self.truth))

    def _integral(self, values: Array) -> NDArray[np.float64]:
        rows = np.concatenate([self.before[:, None], values], axis=1)[..., : len(self.channels.velocities)]
        steps = (rows[:, 1:].astype(np.float64) + rows[:, :-1]) / (2.0 * self.channels.rate_hz)
        return np.asarray(np.cumsum(steps, axis=1))

    def _range(self) -> NDArray[np.float64]:
        """Range of each stroke ``(velocity,)``; without strokes that of the true integrals."""
        if self.channels.strokes:
            return self.stroke_range.astype(np.float64)
        return np.asarray(np.ptp(self._integral(self.truth), axis=(0, 1)))

    def diverged(self) -> NDArray[np.bool_]:
        """Runs that left the machine ``(run,)``: a stroke off by more than `ASTRAY` of its range, or no number."""
        astray = (self.stroke_errors > ASTRAY * self._range()).any(axis=(1, 2))
        return np.asarray(astray | ~np.isfinite(self.answers).all(axis=(1, 2)))


def free_runs(twin: Twin, series: Sequence[Series], seconds: float, starts: int) -> FreeRuns:
    """Let a twin run free from evenly spread starts of each stretch.

    Args:
        twin: any formulation.
        series: inputs are commands, targets are what it answers.
        seconds: length of a run, cut to what the longest stretch has; shorter stretches, and starts
            beyond an end stop of the twin, are left out.
        starts: runs in each stretch.

    Raises:
        DataError: no stretch has a tick behind the prefix.
    """
    rate, prefix = twin.channels.rate_hz, twin.prefix_ticks
    longest = max((part.samples for part in series), default=0)
    ticks = min(round(seconds * rate), longest - prefix - 1)
    if ticks < 1:
        raise DataError(
            f"the longest recording has {longest} ticks ({longest / rate:g} s); the twin needs {prefix} measured ones "
            "and two more to be judged: give longer recordings"
        )
    length = prefix + ticks + 1
    runs = even_starts(twin, series, length, starts)
    answers, truths = [], []
    for first in range(0, len(runs), LANES):
        lanes = runs[first : first + LANES]
        commands = np.stack([part.inputs[at : at + length - 1] for part, at in lanes])
        truth = np.stack([part.targets[at : at + length] for part, at in lanes])
        state = twin.reset(commands[:, :prefix], truth[:, :prefix])
        answers.append(twin.rollout(commands[:, prefix:], state)[0])
        truths.append(truth[:, prefix:])
    whole_truth = np.concatenate(truths)
    names = tuple(part.name for part, _ in runs)
    return runs_of(twin, names, np.concatenate(answers), whole_truth)


def runs_of(twin: Twin, names: tuple[str, ...], answers: Array, truth: Array) -> FreeRuns:
    """Answers of a twin beside what was measured.

    Args:
        twin: that answered.
        names: recording of each run.
        answers: ``(run, tick, answer)``.
        truth: measured ``(run, tick + 1, answer)``, from the last tick before the first answer.
    """
    ends = slice(len(twin.channels.velocities), len(twin.channels.velocities) + len(twin.channels.strokes))
    stroke_range = (twin.scales.high - twin.scales.low)[ends]
    return FreeRuns(twin.channels, names, answers, truth[:, 1:], truth[:, 0], stroke_range)


def free_run_scores(runs: FreeRuns, at_s: Sequence[float]) -> dict[str, Any]:
    """Scores as plain values in the units of reports; velocities, strokes and pressures are never averaged together.

    Args:
        runs: free runs.
        at_s: times after the start at which strokes are compared; those beyond the runs are left out.
    """
    channels, count = runs.channels, len(runs.channels.velocities)
    errors = np.abs(runs.answers - runs.truth)
    velocity_mae = errors[..., :count].mean(axis=(0, 1), dtype=np.float64)
    first = count + len(channels.strokes)
    squares = np.square((runs.answers - runs.truth)[..., first:].astype(np.float64)).mean(axis=(0, 1))
    spread = runs.truth[..., first:].astype(np.float64).std(axis=(0, 1))
    # A pressure that does not move has no scale to measure its error by.
    nrmse = [float(np.sqrt(s) / d) if d > 0 else None for s, d in zip(squares, spread, strict=True)]
    ticks = [(at, round(at * channels.rate_hz)) for at in at_s if round(at * channels.rate_hz) <= runs.truth.shape[1]]
    ends = channels.strokes or channels.velocities
    stroke_errors = runs.stroke_errors
    return {
        "runs": len(runs.names),
        "recordings": len(set(runs.names)),
        "seconds": runs.truth.shape[1] / channels.rate_hz,
        "velocity_mae": _by_channel(channels.velocities, velocity_mae),
        "stroke_error": [
            {"at_s": at, **_by_channel(ends, stroke_errors[:, max(0, tick - 1)], integral=not channels.strokes)}
            for at, tick in ticks
        ],
        "pressure_nrmse": {
            "mean": _mean(nrmse),
            "by_channel": {c.name: value for c, value in zip(channels.pressures, nrmse, strict=True)},
        },
        "diverged": float(runs.diverged().mean()),
    }


def _by_channel(channels: Sequence[Channel], values: NDArray[np.float64], integral: bool = False) -> dict[str, Any]:
    """Mean of each channel in its unit of reports, and over all, with the median over runs, where the unit is one."""
    facts = [KINDS[channel.kind] for channel in channels]
    units = {_integrated(fact.report_unit) if integral else fact.report_unit for fact in facts}
    scaled = values * np.array([fact.report_factor for fact in facts])
    by_run = np.atleast_2d(scaled)
    plain: dict[str, Any] = {c.name: float(x) for c, x in zip(channels, by_run.mean(axis=0), strict=True)}
    row: dict[str, Any] = {"unit": units.pop() if len(units) == 1 else None, "by_channel": plain}
    row["mean"] = None if row["unit"] is None else float(by_run.mean())
    if values.ndim == 2:
        row["median"] = None if row["unit"] is None else float(np.median(by_run))
    return row


def _integrated(unit: str) -> str:
    """Unit of the integral over seconds of what is in `unit`."""
    return unit.removesuffix("/s")


def _mean(values: Sequence[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return float(np.mean(numbers)) if numbers else None
