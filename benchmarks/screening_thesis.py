"""Screening of simulated M22 logs beside the thesis's: lags beside Table 4.2, patterns beside figures 4.1 and 4.2.

The figures are held to what the thesis says of them in words (section 4.1); its numbers are not printed there. Every
statement is listed with what the screening of our data found, met or not; the differences end up in the results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from common import finish, parser, table, verdict
from edp.data_sets import SimulationOrder
from edp.recording import Recording
from edp.screening import Screening, ScreeningSpec, screen
from edp.signals import TABLE_A1
from edp.sim import simulate_many

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

    found: Screening

    def at(self, metric: str, channel: str, target: str) -> float:
        """An entry of one of the matrices."""
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


def lag_rows(found: Screening) -> list[dict[str, Any]]:
    """Lags of each group's channels against their own cylinder, beside Table 4.2."""
    rows = []
    for group, (low, high) in TABLE_4_2.items():
        curves = [found.curve(name, TARGETS[axis]) for axis in range(3) for name in members(group, axis)
                  if name in found.channels]  # fmt: skip
        known = [curve for curve in curves if np.isfinite(curve.value)]
        sure = [curve for curve in known if curve.certain and not curve.at_edge]
        within = [curve for curve in sure if low <= curve.best <= high]
        rows.append({
            "group": group,
            "thesis": [low, high],
            "ours": [min((c.best for c in sure), default=None), max((c.best for c in sure), default=None)],
            "each": {c.channel: {"lag": c.best, "correlation": c.value, "low": c.low, "high": c.high,
                                 "certain": c.certain} for c in known},
            "certain": len(sure),
            "of": len(curves),
            "within": len(within) / len(curves),
        })  # fmt: skip
    return rows


def show_lags(rows: Sequence[dict[str, Any]]) -> None:
    """Print our lags beside Table 4.2, then each channel's own."""
    print("\nLag of the largest correlation with the own cylinder's velocity, samples (negative: the channel leads)")
    cells = []
    for row in rows:
        low, high = row["ours"]
        ours = "-" if low is None else f"{low} to {high}"
        cells.append([row["group"], f"{row['thesis'][0]} to {row['thesis'][1]}", ours, f"{row['certain']}/{row['of']}",
                      f"{row['within']:.0%}"])  # fmt: skip
    table(["group", "Table 4.2", "ours", "certain", "in the thesis's range"], cells)
    print()
    every = [
        [name, one["lag"], f"{one['correlation']:+.2f}", f"{one['low']:.0f} to {one['high']:.0f}",
         "yes" if one["certain"] else "no"]
        for row in rows for name, one in row["each"].items()
    ]  # fmt: skip
    table(["channel", "lag", "correlation", "95 %", "certain"], every)


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
    """What the thesis says of fig. 4.1."""
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
    """What the thesis says of fig. 4.2: pooled over recordings, and each recording for itself."""
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


def of_the_lags(found: Screening, rows: Sequence[dict[str, Any]]) -> list[Statement]:
    """What the thesis says of Table 4.2."""
    statements = [
        Statement(f"lags of the {row['group']}", f"{row['thesis'][0]} to {row['thesis'][1]}",
                  ", ".join(f"{one['lag']}" for one in row["each"].values()), row["within"])
        for row in rows
    ]  # fmt: skip
    mean = {row["group"]: np.mean([one["lag"] for one in row["each"].values()]) for row in rows}
    first = sorted(mean, key=lambda group: mean[group])[:2]
    statements.append(
        Statement("which groups lead most", "pilots and conflux", " and ".join(first),
                  float(all("pilot" in group for group in first)))
    )  # fmt: skip
    longest = -min(one["lag"] for row in rows for one in row["each"].values() if one["certain"])
    statements.append(
        Statement("longest certain lag", f"about {SEEN} samples", f"{longest} samples", float(longest <= 1.25 * SEEN))
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
    """The recording without what only a simulation knows."""
    return Recording(recording.name, tuple(TABLE_A1.values()), np.ascontiguousarray(recording.select(list(TABLE_A1))),
                     recording.rate_hz, recording.source, recording.meta)  # fmt: skip


def main() -> None:
    """Command line."""
    options = parser(__doc__.splitlines()[0])
    options.add_argument("--workers", type=int, default=2)
    given = options.parse_args()
    recordings = data_set(6.0 if given.quick else 60.0, given.seed, given.workers)
    found = screen(recordings, ScreeningSpec(targets=TARGETS, seed=given.seed))
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
    verdicts = [verdict("statements of section 4.1 met", met, len(statements), ">= 0.7", "statements", given.quick)]
    details = {"lags": rows, "statements": [asdict(s) for s in statements], "window": found.proposal.window_reason}
    finish(Path(__file__).stem, verdicts, given.seed, details)


if __name__ == "__main__":
    main()
