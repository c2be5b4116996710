"""Differences between runs on their common recordings, with paired intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, count_of
from edp.evaluation.guard import LEAST, ErrorOutcome
from edp.report.compare.runs import FREE, MEAN, ComparedRun, Measure, read_runs, recording_that_differs
from edp.report.run.facts import NETWORK, TRUTH
from edp.stats.multiple import holm
from edp.stats.resampled import paired_t
from edp.wording import figure, listed, number, percent

FEWEST = 3
"""Minimum number of common recordings for an interval over recordings. Two recordings leave one degree of freedom."""
BLOCK_S = 10.0
"""Length of a block in s. Excavator movements take 2 to 5 s, so neighbouring blocks have nearly uncorrelated errors."""
FEWEST_BLOCKS = 6
NAMED = 3
"""Maximum number of runs in the headline."""
Array = NDArray[np.floating]


@dataclass(frozen=True)
class RunDifference:
    """Difference between the error of a run and the error of the first run.

    Attributes:
        change: mean difference over the first run's mean error, -0.2 for a fifth less.
        low, high: 95 % interval of it; None where nothing could be paired.
        p: two-sided, adjusted after Holm for the runs compared; None in the same cases.
        over: ``recordings`` or ``blocks``, what was paired.
        count: number of recordings.
        better: recordings on which this run has less error.
    """

    change: float
    low: float | None
    high: float | None
    p: float | None
    over: str
    count: int
    better: int

    @property
    def told_apart(self) -> bool:
        """Whether the adjusted p-value is below 5 % and the change is more than rounding and threads make."""
        return self.p is not None and self.p < 0.05 and abs(self.change) > LEAST

    def text(self) -> str:
        """Return the difference in words, without the names of the runs."""
        amount = f"{percent(abs(self.change))} {'less' if self.change < 0 else 'more'} error"
        if self.low is None or self.high is None:
            return f"{amount} (no interval: too little in common)"
        return f"{amount} (95 % interval {percent(self.low, signed=True)} to {percent(self.high, signed=True)})"


@dataclass(frozen=True, eq=False)
class Comparison:
    """Comparison of several runs on their common recordings and measures; the first run is the reference.

    Attributes:
        runs: two or more, of one kind.
        recordings: test recordings of all of them, by name.
        measures: errors that all of them have, the first one of the headline.
        remarks: remarks on omitted recordings, other data and different settings.
    """

    runs: tuple[ComparedRun, ...]
    recordings: tuple[str, ...]
    measures: tuple[Measure, ...]
    remarks: tuple[str, ...]

    def errors(self, run: ComparedRun, measure: Measure) -> NDArray[np.float64]:
        """Return the errors of a run on the common recordings ``(recording,)``."""
        return np.array([run.errors[measure][name] for name in self.recordings])

    def error(self, run: ComparedRun, measure: Measure) -> float:
        """Return the mean over the common recordings, each of the same weight."""
        return float(self.errors(run, measure).mean())

    def differences(self, measure: Measure) -> dict[str, RunDifference]:
        """Return the difference of each run from the first one, by name."""
        first, *others = self.runs
        base = self.errors(first, measure)
        rows = []
        for run in others:
            own = self.errors(run, measure)
            change, over = own - base, "recordings"
            if len(change) < FEWEST:
                change, over = _blocks(first, run, measure, self.recordings), "blocks"
            rows.append((run, own, change, over))
        tests = [paired_t(change) if _enough(change, over) else None for _, _, change, over in rows]
        raw = [float(test.two_sided) for test in tests if test is not None]
        adjusted = iter(holm(raw) if raw else ())
        scale, results = float(base.mean()) or 1.0, {}
        for (run, own, change, over), test in zip(rows, tests, strict=True):
            low, high = (float(end) / scale for end in test.interval()) if test is not None else (None, None)
            p = float(next(adjusted)) if test is not None else None
            relative = float((own - base).mean()) / scale
            if over == "blocks" and test is not None:
                # The interval belongs to the kept part, whose mean may be another than that of the whole recording.
                relative = float(test.mean) / scale
            results[run.name] = RunDifference(relative, low, high, p, over, len(change), int((own < base).sum()))
        return results

    def headline(self) -> str:
        """State which run has less error, and whether the difference is more than chance."""
        measure, first = self.measures[0], self.runs[0]
        parts = []
        for name, difference in sorted(self.differences(measure).items(), key=lambda item: item[1].change)[:NAMED]:
            if difference.told_apart:
                parts.append(f"{name} has {difference.text()}")
            else:
                sign = percent(difference.change, signed=True)
                ends = (difference.low, difference.high)
                reach = "" if None in ends else f", 95 % interval {' to '.join(percent(e, signed=True) for e in ends)}"
                parts.append(f"{name} is {ErrorOutcome.OPEN} ({sign}{reach})")
        rest = len(self.runs) - 1 - len(parts)
        more = f"; {rest} more below" if rest > 0 else ""
        error = f"{number(self.error(first, measure))} {measure.unit}".rstrip()
        what = "" if measure.output == MEAN else f" of {measure.output}"
        return f"Against {first.name} ({error}{what}, {measure.when}): {'; '.join(parts)}{more}."


def compare_runs(folders: Sequence[str | Path]) -> Comparison:
    """Compare evaluated runs on their common recordings and measures.

    Args:
        folders: run folders; the others are measured against the first.

    Raises:
        ConfigError: too few, too many, or one twice.
        StorageError: a folder holds no evaluated run, or something damaged.
        DataError: twins beside networks, no common recording or error, or recordings of one name that differ.
    """
    runs = read_runs(folders)
    measures = [measure for measure in runs[0].errors if all(measure in run.errors for run in runs)]
    if not measures:
        raise DataError(f"{_offers(runs)}: no output and time ahead is common to all; compare runs of one task")
    names = set.intersection(*(run.recordings for run in runs))
    if not names:
        raise DataError(
            f"the runs {listed(run.name for run in runs)} have no test recording in common; judge them on the same "
            "logs (edp evaluate RUN --data LOGS), and compare the folders that it names"
        )
    for run in runs[1:]:
        if other := recording_that_differs(runs[0], run, names):
            raise DataError(
                f"recording '{other}' is not the same in {runs[0].name} and {run.name}: its measured values differ; "
                "judge both on the same logs (edp evaluate RUN --data LOGS)"
            )
    # The longest time ahead is the hardest; the mean, where there is one, stands before single outputs.
    ordered = sorted(measures, key=lambda m: (-m.ahead_s, m.what.startswith("velocity"), measures.index(m)))
    return Comparison(tuple(runs), tuple(sorted(names)), tuple(ordered), tuple(_remarks(runs, names)))


def _offers(runs: Sequence[ComparedRun]) -> str:
    parts = []
    for run in runs[:NAMED]:
        texts = [measure.text() for measure in run.errors]
        parts.append(f"{run.name} has {', '.join(texts[:3])}{', ...' if len(texts) > 3 else ''}")
    return "; ".join(parts)


def _remarks(runs: Sequence[ComparedRun], names: set[str]) -> list[str]:
    remarks = []
    for run in runs:
        left = sorted(run.recordings - names)
        without = listed(left) if len(left) <= NAMED else f"{left[0]} and {len(left) - 1} more"
        if left:
            remarks.append(
                f"{run.name} was judged on {count_of(len(run.recordings), 'recording')}; compared are the "
                f"{len(names)} that all "
                f"runs share, without {without}."
            )
    digests = {run.digest for run in runs if run.digest}
    if len(digests) > 1:
        all_there = all(names <= run.predictions.keys() for run in runs)
        remarks.append(
            "The runs read other sets of recordings"
            + (
                "; the common ones hold the same values."
                if all_there
                else "; recordings of one name are taken to be the same, as not all of them were kept to compare."
            )
        )
    if len({run.skip for run in runs}) > 1:
        skips = listed(f"{run.skip} ({run.name})" for run in runs)
        remarks.append(f"The runs leave out different numbers of first ticks of a recording: {skips}.")
    if len({run.rate_hz for run in runs if run.rate_hz}) > 1:
        remarks.append("The runs sample at different rates; times ahead are compared in seconds.")
    if len(names) < FEWEST:
        remarks.append(
            f"{count_of(len(names), 'common recording')} cannot speak for other recordings: intervals "
            f"are over blocks of {figure(BLOCK_S)} s of what was kept of them."
        )
    return remarks


def _enough(change: Array, over: str) -> bool:
    return len(change) >= (FEWEST if over == "recordings" else FEWEST_BLOCKS)


def _blocks(first: ComparedRun, second: ComparedRun, measure: Measure, names: Sequence[str]) -> NDArray[np.float64]:
    """Return differences of the mean absolute error ``(block,)`` in segments of `BLOCK_S` of common predictions."""
    if first.kind == FREE or first.rate_hz != second.rate_hz or not first.rate_hz:
        return np.empty(0)
    length = max(round(BLOCK_S * first.rate_hz), 1)
    changes: list[float] = []
    for name in names:
        base, own = (_absolute(run, name, measure) for run in (first, second))
        if base is None or own is None:
            continue
        start = max(first.skip, second.skip)
        change = (own - base)[start:]
        whole = len(change) // length * length
        changes += np.nanmean(change[:whole].reshape(-1, length), axis=1).tolist() if whole else []
    values = np.array(changes)
    return np.asarray(values[np.isfinite(values)])


def _absolute(run: ComparedRun, name: str, measure: Measure) -> Array | None:
    """Return (time,) absolute error of a measure at each tick, mean over outputs where it is theirs; report units."""
    parts, horizon = run.predictions.get(name, {}), round(measure.ahead_s * (run.rate_hz or 1.0))
    if NETWORK not in parts or horizon not in run.horizons:
        return None
    column = run.horizons.index(horizon)
    targets = [target for target, _ in run.targets] if measure.output == MEAN else [measure.output]
    errors = []
    for target in targets:
        column_and_factor = run.target(target)
        if column_and_factor is None:
            return None
        predicted, truth = parts[NETWORK][:, column, column_and_factor[0]], parts[TRUTH][:, column_and_factor[0]]
        ahead = np.full(len(truth), np.nan)
        ahead[: len(truth) - horizon] = truth[horizon:]
        errors.append(np.abs(predicted - ahead) * column_and_factor[1])
    return np.asarray(np.mean(errors, axis=0, dtype=np.float64))
