"""Fleet in figures: machines by error, drift and alarms, with the probable causes of the worst ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edp.errors import count_of
from edp.report.fleet.result import FleetReport, MachineErrors, ReportedMachine
from edp.table import Column, Table, Value, figures
from edp.wording import figure, number, percent

WORST = 10
SURE_T = 4.0
"""Minimum Welch t for a drift. By chance, one machine in 30,000 exceeds it if blocks are independent."""
DRIFTS = 1.15
"""Minimum ratio of the errors of both halves for a reported drift."""
FAR = 4.0
"""Distance from the fleet's median, in robust standard deviations, above which an input is reported as unusual."""
LARGER = 1.3
"""Multiple of the fleet's median above which an error or a speed is reported as large."""
NORMAL = 1.4826
"""Ratio of the standard deviation to the median absolute deviation of a normal distribution."""


@dataclass(frozen=True)
class FleetRow:
    """A machine.

    Attributes:
        name: name of the machine.
        minutes: total length of its recordings, min.
        mae: mean absolute error over outputs and ticks, report units.
        skill: share of the error of persistence that the network takes away.
        drift: error of the second half over that of the first; None where the recordings are too short to tell.
        drifts: whether that is more than chance.
        changes: changes reported by a monitor; None without one.
        own: whether the network is its own.
        why: conspicuous properties, the most important first.
    """

    name: str
    minutes: float
    mae: float
    skill: float
    drift: float | None
    drifts: bool
    changes: int | None
    own: bool
    why: tuple[str, ...]


@dataclass(frozen=True)
class FleetFacts:
    """A fleet.

    Attributes:
        title: title of the page.
        unit: unit of errors.
        ahead_ms: time that is looked ahead.
        rows: machines, the worst first.
        failed: machines that could not be evaluated, and why.
        report: content of ``fleet_report.json``.
    """

    title: str
    unit: str
    ahead_ms: float
    rows: tuple[FleetRow, ...]
    failed: tuple[tuple[str, str], ...]
    report: FleetReport

    @property
    def median(self) -> float:
        """Return the median error of the evaluated machines; NaN without evaluated machines."""
        return float(np.median([row.mae for row in self.rows])) if self.rows else float("nan")


def fleet_facts(report: FleetReport, title: str) -> FleetFacts:
    """Return the figures and sentences of a fleet report."""
    units = {target.unit for target in report.targets}
    failed = tuple((row.machine, row.failed) for row in report.machines if row.errors is None)
    usual = _Usual(
        [row.errors for row in report.machines if row.errors is not None], [target.name for target in report.targets]
    )
    rows = [usual.row(row, row.errors) for row in report.machines if row.errors is not None]
    ahead = 1e3 * report.horizon / report.rate_hz
    unit = units.pop() if len(units) == 1 else "mixed units"
    return FleetFacts(title, unit, ahead, tuple(sorted(rows, key=lambda row: -row.mae)), failed, report)


class _Usual:
    """Typical values of the fleet and the departure of a machine from them."""

    def __init__(self, judged: Sequence[MachineErrors], targets: Sequence[str]) -> None:
        self.targets = targets
        self.by_target = np.median([row.by_target for row in judged], axis=0) if judged else np.zeros(0)
        self.still = float(np.median([row.persistence for row in judged])) if judged else 0.0
        self.inputs: dict[tuple[str, str], tuple[float, float]] = {}
        for name in judged[0].inputs if judged else ():
            for statistic in ("mean", "std"):
                values = np.array([getattr(row.inputs[name], statistic) for row in judged])
                middle = float(np.median(values))
                self.inputs[name, statistic] = (middle, NORMAL * float(np.median(np.abs(values - middle))))

    def row(self, machine: ReportedMachine, row: MachineErrors) -> FleetRow:
        drift, alarms = row.drift, row.alarms
        drifts = drift is not None and drift.t > SURE_T and drift.ratio > DRIFTS
        return FleetRow(
            name=machine.machine,
            minutes=machine.minutes,
            mae=row.mae,
            skill=1.0 - row.mae / row.persistence if row.persistence else 0.0,
            drift=None if drift is None else drift.ratio,
            drifts=drifts,
            changes=None if alarms is None or alarms.failed else alarms.changes,
            own=row.own,
            why=tuple(self._why(row, drifts)),
        )

    def _why(self, row: MachineErrors, drifts: bool) -> list[str]:
        reasons = [*self._outputs(row), *self._speed(row)]
        if drifts and row.drift is not None:
            grown = percent(row.drift.ratio - 1.0)
            reasons.append(f"the error grew by {grown} from the first half of its time to the second")
        alarms = row.alarms
        if alarms is not None and alarms.changes:
            reasons.append(f"the monitor told of {count_of(alarms.changes, 'change')}, first: {alarms.first[0]}")
        return [*reasons, *self._unusual(row)]

    def _outputs(self, row: MachineErrors) -> list[str]:
        """Name the output whose error departs most from the fleet's."""
        ratios = np.asarray(row.by_target) / np.maximum(self.by_target, 1e-30)
        worst = int(np.argmax(ratios))
        if ratios[worst] < LARGER:
            return []
        return [f"the error of {self.targets[worst]} is {ratios[worst]:.1f} times the fleet's median"]

    def _speed(self, row: MachineErrors) -> list[str]:
        """Return whether its outputs simply change faster."""
        ratio = row.persistence / self.still if self.still else 1.0
        return [f"its outputs change {ratio:.1f} times as fast as the fleet's"] if ratio > LARGER else []

    def _unusual(self, row: MachineErrors) -> list[str]:
        """Name the input that departs most from the fleet's, in robust deviations."""
        words = {"mean": "lies", "std": "varies"}
        far = []
        for (name, statistic), (middle, spread) in self.inputs.items():
            away = abs(getattr(row.inputs[name], statistic) - middle) / spread if spread > 0 else 0.0
            far.append((away, name, statistic))
        away, name, figure = max(far, default=(0.0, "", "mean"))
        return [f"input {name} {words[figure]} {away:.0f} deviations off the fleet"] if away > FAR else []


def headline(facts: FleetFacts) -> str:
    """State the result for the fleet in one sentence."""
    if not facts.rows:
        return f"None of {len(facts.failed)} machines could be judged."
    worst = facts.rows[0]
    return (
        f"{count_of(len(facts.rows), 'machine')}, median error {number(facts.median)} {facts.unit} "
        f"{figure(facts.ahead_ms)} ms ahead; "
        f"the worst is {worst.name} with {number(worst.mae)} {facts.unit}."
    )


def verdict(facts: FleetFacts) -> list[str]:
    """Return the sentences after the headline."""
    drifting = sum(row.drifts for row in facts.rows)
    lines = [f"{drifting} of {len(facts.rows)} machines drift: their error grew over the time of their logs."]
    watched = [row for row in facts.rows if row.changes is not None]
    if watched:
        changed = sum(bool(row.changes) for row in watched)
        lines.append(f"The monitor told of changes on {changed} of {len(watched)}.")
    else:
        lines.append("No monitor watched.")
    if facts.failed:
        lines.append(f"{count_of(len(facts.failed), 'machine')} could not be evaluated: see the end of the table.")
    own = sum(row.own for row in facts.rows)
    if own:
        lines.append(f"{own} ran under their own delta.")
    return lines


def tiles(facts: FleetFacts) -> list[tuple[str, str, str]]:
    """Return key figures: value, unit, description."""
    errors = [row.mae for row in facts.rows]
    hours = sum(row.minutes for row in facts.rows) / 60.0
    high = float(np.quantile(errors, 0.9)) if errors else float("nan")
    return [
        (str(len(facts.rows)), "", "machines"),
        (number(hours), "h", "of recordings"),
        (number(facts.median), facts.unit, "error of the median machine"),
        (number(high), facts.unit, "error that one machine in ten exceeds"),
        (str(sum(row.drifts for row in facts.rows)), "", "machines drift"),
    ]


def worst_table(facts: FleetFacts) -> Table:
    """Return the worst machines with the probable causes."""
    rows: list[tuple[Value, ...]] = [
        (row.name, row.mae, "; ".join(row.why) or "nothing stands out: the network is less exact here")
        for row in facts.rows[:WORST]
    ]
    columns = (
        Column("Machine"),
        Column("Error", facts.unit, figures(row[1] for row in rows)),
        Column("Why", is_text=True),
    )
    return Table(f"The {len(rows)} machines with the largest error", columns, tuple(rows), name="worst")


def machine_table(facts: FleetFacts) -> Table:
    """Return every machine."""
    rows: list[tuple[Value, ...]] = [
        (row.name, row.minutes, row.mae, percent(row.skill), row.drift, "yes" if row.drifts else "", row.changes)
        for row in facts.rows
    ]
    columns = (
        Column("Machine"),
        Column("Logs", "min", figures((row[1] for row in rows), decimals=1)),
        Column("Error", facts.unit, figures(row[2] for row in rows)),
        Column("Better than persistence"),
        Column("Error, 2nd over 1st half", "", figures((row[4] for row in rows), decimals=2)),
        Column("Drifts"),
        Column("Changes told"),
    )
    marked = frozenset(n for n, row in enumerate(facts.rows) if row.drifts or row.changes)
    return Table("All machines, the largest error first", columns, tuple(rows), marked, name="machines")


def tabulate_failures(facts: FleetFacts) -> Table:
    """Return the machines without an evaluation, with the reasons."""
    return Table("Machines that could not be judged", (Column("Machine"), Column("Why", is_text=True)), facts.failed)
