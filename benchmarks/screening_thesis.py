"""Screening of simulated M22 logs beside the thesis's: lags beside Table 4.2, patterns beside figures 4.1 and 4.2.

The figures are held to what the thesis says of them in words (section 4.1); its numbers are not printed there. Every
statement is listed with what the screening of our data found, met or not; the differences end up in the results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from common import Bench, benchmark, option, table
from edp.data.screening import ScreeningResult, ScreeningSpec, screen
from edp.recording import Recording
from edp.signals import TABLE_A1
from edp.sim import simulate_many
from edp.sim.data_set import SimulationOrder

CYLINDERS = ("boom", "arm", "bucket")
TARGETS = ("CylVels_1", "CylVels_2", "CylVels_3")
PILOTS = (("BmUp", "BmDwn"), ("AmIn", "AmOut"), ("BktIn", "BktOut"))
TABLE_4_2 = {"cylinder pressure": (-8, -4), "pilot pressure": (-18, -12), "conflux pilot pressure": (-20, -13),
             "cylinder acceleration": (-12, -5)}  # fmt: skip
SEEN = 20
"""Samples within which the thesis finds the most that history tells, and the window that it then chose."""
WINDOW = 50


def members(group: str, axis: int) -> tuple[str, ...]:
    """Channels of a group of Table 4.2 that belong to a cylinder."""
    if group == "cylinder pressure":
        return (f"CylPressures_{axis + 1}", f"CylPressures_{axis + 5}")
    if group == "cylinder acceleration":
        return (f"CylAcc_{axis + 1}",)
    suffix = "Conf" if group.startswith("conflux") else ""
    return tuple(name + suffix for name in PILOTS[axis])


@dataclass(frozen=True)
class Statement:
    """One thing that the thesis says, and what was found here.

    Attributes:
        name: of the statement.
        thesis: what it says.
        ours: figures, in words.
        met: share of the cases that agree, 0 to 1.
    """

    name: str
    thesis: str
    ours: str
    met: float


@dataclass(frozen=True)
class Figures:
    """A screening with places by name."""

    found: ScreeningResult

    def at(self, metric: str, channel: str, target: str) -> float:
        """Return an entry of one of the matrices."""
        names = self.found.matrices.names
        if channel not in names:
            return float("nan")
        matrix = getattr(self.found.matrices, metric)
        return float(matrix[names.index(channel), names.index(target)])

    def group(self, metric: str, group: str, axis: int, target: int) -> float:
        """Largest size of a metric between a cylinder's channels of a group and a target."""
        values = [abs(self.at(metric, name, TARGETS[target])) for name in members(group, axis)]
        return float(np.nanmax([0.0, *values]))

    def pieces(self, metric: str, channel: str, target: str) -> float:
        """Mean of a metric over the recordings, each for itself; NaN where it was not measured."""
        for row in self.found.stability:
            if (row.metric, row.channel, row.target) == (metric, channel, target):
                return row.mean
        return float("nan")


@dataclass(frozen=True)
class Lag:
    """Where a channel goes best with its cylinder's velocity.

    Attributes:
        channel: name.
        best: lag of the largest size of the correlation on either side, with its 95 % interval `low` to `high`.
        value: correlation there.
        certain: it is no chance.
        leading: lag of the largest correlation (eq. 2.13) among those at which the channel leads or is simultaneous,
            in the direction in which it drives the piston: what retracts it (retract pilots, rod pressures) counts
            with the opposite sign.
        led: correlation there, in that direction.
        open: the largest one is at an end of the leading side, so no peak.
    """

    channel: str
    best: int
    low: float
    high: float
    value: float
    certain: bool
    leading: int
    led: float
    open: bool


def lag_of(found: ScreeningResult, channel: str, target: str) -> Lag:
    """One row of the table of lags."""
    curve = found.curve(channel, target)
    retracts = channel.removesuffix("Conf") in {pair[1] for pair in PILOTS} or channel[-1] in "567"
    side = (curve.lags <= 0) & (curve.lags >= -3 * SEEN)
    driven = curve.correlation[side] * (-1.0 if retracts else 1.0)
    peak = int(np.argmax(driven))
    return Lag(channel, curve.best, curve.low, curve.high, curve.value, curve.certain, int(curve.lags[side][peak]),
               float(driven[peak]), peak in (0, len(driven) - 1))  # fmt: skip


def lag_rows(found: ScreeningResult) -> list[dict[str, Any]]:
    """Lags of each group's channels against their own cylinder, beside Table 4.2."""
    rows = []
    for group, (low, high) in TABLE_4_2.items():
        lags = [lag_of(found, name, TARGETS[axis]) for axis in range(3) for name in members(group, axis)
                if np.isfinite(found.curve(name, TARGETS[axis]).value)]  # fmt: skip
        peaks = [lag for lag in lags if not lag.open]
        rows.append({
            "group": group,
            "thesis": [low, high],
            "leading": [min((lag.leading for lag in peaks), default=None), max((lag.leading for lag in peaks),
                        default=None)],
            "either side": [min(lag.best for lag in lags), max(lag.best for lag in lags)],
            "peaks": len(peaks),
            "of": len(lags),
            "within": sum(low <= lag.leading <= high for lag in peaks) / len(lags),
            "each": [asdict(lag) for lag in lags],
        })  # fmt: skip
    return rows


def show_lags(rows: Sequence[dict[str, Any]]) -> None:
    """Print our lags beside Table 4.2, then each channel's own."""
    print("\nLags at which channels go best with their own cylinder's velocity, samples (negative: the channel leads)")
    cells = [
        [row["group"], "{} to {}".format(*row["thesis"]), "{} to {}".format(*row["leading"]),
         f"{row['peaks']}/{row['of']}", f"{row['within']:.0%}", "{} to {}".format(*row["either side"])]
        for row in rows
    ]  # fmt: skip
    table(
        ["group", "Table 4.2", "ours, leading side", "with a peak", "in the thesis's range", "ours, either side"], cells
    )
    print()
    every = [
        [one["channel"], "none" if one["open"] else one["leading"], f"{one['led']:+.2f}", one["best"],
         f"{one['value']:+.2f}", f"{one['low']:.0f} to {one['high']:.0f}", "yes" if one["certain"] else "no"]
        for row in rows for one in row["each"]
    ]  # fmt: skip
    table(["channel", "leading", "correlation", "either side", "correlation", "95 %", "certain"], every)


def show_pattern(figures: Figures, metric: str, title: str) -> None:
    """Print a matrix by groups: the own cylinder's channels of each group against each target."""
    print(f"\n{title}: largest size by group of channels (rows) and velocity (columns)")
    rows = []
    for group in TABLE_4_2:
        for axis, cylinder in enumerate(CYLINDERS):
            values = [figures.group(metric, group, axis, target) for target in range(3)]
            rows.append([f"{group}, {cylinder}", *(f"{value:.2f}" for value in values)])
    table(["", *CYLINDERS], rows)


def _triple(values: Sequence[float]) -> str:
    return "/".join(f"{value:.2f}" for value in values)


def of_the_correlations(figures: Figures) -> list[Statement]:
    found = figures.found
    names = [name for name in found.matrices.names if name not in TARGETS]
    by_metric = {
        metric: np.array([figures.at(metric, name, target) for name in names for target in TARGETS])
        for metric in ("pearson", "spearman", "kendall")
    }
    known = np.isfinite(np.sum(list(by_metric.values()), axis=0))
    agree = [
        float(np.corrcoef(by_metric[a][known], by_metric[b][known])[0, 1])
        for a, b in (("pearson", "spearman"), ("pearson", "kendall"), ("spearman", "kendall"))
    ]
    statements = [
        Statement("Pearson, Spearman and Kendall agree", "highly consistent trends", _triple(agree),
                  float(min(agree) > 0.9))
    ]  # fmt: skip
    for group in ("pilot pressure", "conflux pilot pressure"):
        own = [figures.group("spearman", group, axis, axis) for axis in range(3)]
        other = [max(figures.group("spearman", group, axis, t) for t in range(3) if t != axis) for axis in range(3)]
        statements.append(
            Statement(f"Spearman: {group} with its own velocity", "pronounced", f"{_triple(own)}; others' at most "
                      f"{_triple(other)}", float(np.mean([o > 0.3 and o > e for o, e in zip(own, other)])))
        )  # fmt: skip
    small = [figures.group("spearman", "cylinder acceleration", axis, axis) for axis in range(3)]
    statements.append(
        Statement("Spearman: acceleration with its own velocity", "minimal", _triple(small),
                  float(np.mean([value < 0.15 for value in small])))
    )  # fmt: skip
    return statements


def of_the_information(figures: Figures) -> list[Statement]:
    """Return the thesis's statements on fig. 4.2, pooled over recordings and for each recording."""
    statements = []
    for form in ("pooled", "per recording"):

        def size(group: str, axis: int, target: int, form: str = form) -> float:
            if form == "pooled":
                return figures.group("information", group, axis, target)
            values = [figures.pieces("information", name, TARGETS[target]) for name in members(group, axis)]
            return float(np.nanmax([0.0, *values]))

        pressure, pilot, conflux, moved = (
            [size(group, axis, axis) for axis in range(3)]
            for group in ("cylinder pressure", "pilot pressure", "conflux pilot pressure", "cylinder acceleration")
        )
        rest = [max(a, b, c) for a, b, c in zip(pilot, conflux, moved, strict=True)]
        statements += [
            Statement(f"MI, {form}: pressure with its own velocity", "highest of all groups",
                      f"{_triple(pressure)}; others' at most {_triple(rest)}",
                      float(np.mean([p > r for p, r in zip(pressure, rest)]))),
            Statement(f"MI, {form}: acceleration", "notably higher than its correlations", _triple(moved),
                      float(np.mean([value > 0.05 for value in moved]))),
            Statement(f"MI, {form}: pilots with their own velocity", "distinct coupling", _triple(pilot),
                      float(np.mean([size("pilot pressure", a, a) > max(size("pilot pressure", a, t)
                                     for t in range(3) if t != a) for a in range(3)]))),
        ]  # fmt: skip
    return statements


def of_the_lags(found: ScreeningResult, rows: Sequence[dict[str, Any]]) -> list[Statement]:
    statements = [
        Statement(f"lags of the {row['group']}", f"{row['thesis'][0]} to {row['thesis'][1]}",
                  ", ".join("no peak" if one["open"] else f"{one['leading']}" for one in row["each"]), row["within"])
        for row in rows
    ]  # fmt: skip
    peaks = {row["group"]: [one["leading"] for one in row["each"] if not one["open"]] for row in rows}
    first = sorted(peaks, key=lambda group: float(np.mean(peaks[group] or [0])))[:2]
    statements.append(
        Statement("which groups lead most", "pilots and conflux", " and ".join(first),
                  float(all("pilot" in group for group in first)))
    )  # fmt: skip
    longest = -min(lag for lags in peaks.values() for lag in lags)
    statements.append(
        Statement("longest lead", f"about {SEEN} samples", f"{longest} samples", float(longest <= 1.25 * SEEN))
    )
    window = found.proposal.window
    statements.append(
        Statement("window", f"{WINDOW} samples suffice", f"{window} samples suggested", float(window <= WINDOW))
    )
    return statements


def data_set(minutes: float, seed: int, workers: int) -> list[Recording]:
    """M22's default data set, the channels of Table A.1 alone."""
    plan = SimulationOrder(minutes=minutes, recordings=max(7, round(minutes / 2)), seed=seed).scenarios()
    return [only_table_a1(recording) for recording in simulate_many(plan, workers)]


def only_table_a1(recording: Recording) -> Recording:
    """Remove the channels that only a simulation has."""
    return Recording(recording.name, tuple(TABLE_A1.values()), np.ascontiguousarray(recording.select(list(TABLE_A1))),
                     recording.rate_hz, recording.source, recording.meta)  # fmt: skip


@benchmark(option("--workers", type=int, default=2))
def main(bench: Bench) -> object:
    recordings = data_set(6.0 if bench.quick else 60.0, bench.seed, bench.options.workers)
    found = screen(recordings, ScreeningSpec(targets=TARGETS, seed=bench.seed))
    figures, rows = Figures(found), lag_rows(found)
    show_lags(rows)
    show_pattern(figures, "spearman", "Spearman (fig. 4.1)")
    show_pattern(figures, "information", "mutual information in nat (fig. 4.2)")
    statements = of_the_lags(found, rows) + of_the_correlations(figures) + of_the_information(figures)
    print("\nWhat the thesis says of its data, and ours")
    words = {0.0: "not met", 1.0: "met"}
    table(["statement", "thesis", "ours", "verdict"],
          [[s.name, s.thesis, s.ours, words.get(s.met, f"{s.met:.0%} of them")] for s in statements])  # fmt: skip
    met = float(sum(statement.met for statement in statements))
    bench.check("statements of section 4.1 met", met, len(statements), ">= 0.7", "statements")
    return {"lags": rows, "statements": [asdict(s) for s in statements], "window": found.proposal.window_reason}


if __name__ == "__main__":
    main()
