"""How good is the default twin on recordings that other people made, in free run on commands alone?

Each set is a machine with one actuator: a command, and a velocity (backward difference of the position or level) with
its integral. Where what is scored does not integrate anything (the pressure of the arm, the speed of a drive), it
stands in the place of the velocity, alone. The twin is what `edp twin` chooses without settings from the estimation
data; where the description of a set names its parts (two tanks, an axis with a drive), these elements are one more
candidate. It is measured for a few ticks and then runs on the commands through the whole test recording.

Published leagues have their leaders beside it. Sets from outside were chosen before anything was run on them; all have
the static map, ARX, a subspace model and a NARX model beside it, fitted in the same run to the same estimation data.

The recordings are no part of the repository: the folder of the leagues is given by --shared or EDP_SHARED_DATA, that
of the sets from outside by --outside: drive, ballbeam, damper and dryer (.mat) as github.com/RomanFoell/DRGP-VSS has
them in matlab/data_raw. --work keeps what is finished, so that a run may be stopped, and divided: each part is a run
of its own with --only and --seed, also on another machine, all with one --work folder (or with folders whose files are
put together); a last run over all sets and seeds with that folder reads them, and gives the tables.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from common import Verdict, finish, in_folder, kept, parser, table, verdict
from edp.config.twin import TwinExperiment, load_twin_experiment, with_budget
from edp.data.series import Series
from edp.data.stretch_folds import StretchFold
from edp.data.twin_channels import TwinChannels, twin_channels
from edp.evaluation.free_run import calibrated, coverage_of, free_runs
from edp.logs.source import DataSource
from edp.networks.twin import TWINS, Twin, fit_scales
from edp.networks.twin.elements import ElementsBox
from edp.networks.twin.lumped.parts import MassElement, TankElement
from edp.recording import Recording
from edp.settings.tree import read_toml
from edp.signals import Channel, Kind
from edp.storage.provenance import environment
from edp.storage.runs import KeyedRun, Run
from edp.workflows.twin.choose_twin import TwinChoice
from edp.workflows.twin.fit_twin import FittedFormulation, TwinFit
from published_leagues import verdicts_of
from real_recordings import EXAMPLES, VARIABLE, shared_folder
from twin_rivals import fit_narx

ESTIMATION = 0.8
"""Share of the estimation data that trains where nothing is left out in turn; the rest chooses."""
RIVALS = ("static", "arx", "n4sid")
QUICK = ("training.updates=[20,20,20,20]", "training.lanes=16")
STARTS, HALF = 64, 0.5
"""Free runs along the test recording on which intervals are judged, each of at most this share of it."""


@dataclass(frozen=True)
class LeagueSet:
    """How a set becomes a machine with one actuator.

    Attributes:
        command: column of the command.
        stroke: column of the position or level; empty for none.
        velocity: column of the velocity; empty for the backward difference of the stroke.
        target: answer that is scored.
        prefix_ticks: measured ticks before the free run.
        elements: what the description of the set says that it is made of; None where it names no parts.
    """

    command: str
    stroke: str
    velocity: str
    target: str
    prefix_ticks: int
    elements: ElementsBox | None = None


@dataclass(frozen=True)
class OutsideSet:
    """A set from outside: file, what it is, sample time, and how many rows are for estimation.

    Attributes:
        machine: how it becomes a machine with one actuator.
        what: in words.
        unit: of what is scored.
        sample_time_s: as its authors say.
        rows: for estimation and in all, as in the literature.
    """

    machine: LeagueSet
    what: str
    unit: str
    sample_time_s: float
    rows: tuple[int, int]


TWO_TANKS = ElementsBox(
    tanks=(TankElement(name="upper", source="command"), TankElement(name="lower", source="upper", level="stroke"))
)
AXIS = ElementsBox(masses=(MassElement(name="axis", command="command", velocity="velocity"),))
SETS = {
    "tanks.toml": LeagueSet("u", "y", "", "stroke", 5, TWO_TANKS),
    "emps.toml": LeagueSet("u", "q", "", "stroke", 20, AXIS),
    "sjoberg.toml": LeagueSet("u", "", "p", "velocity", 10),
}
GOALS = {"tanks.toml": 0.25, "emps.toml": 3.0, "sjoberg.toml": 0.55}
"""Largest free-run error that was asked for, in the unit of the league (medians of five seeds)."""
OUTSIDE = {
    "drive": OutsideSet(LeagueSet("u1", "", "z1", "velocity", 10), "coupled electric drives", "V", 0.02, (250, 500)),
    "ballbeam": OutsideSet(LeagueSet("X", "y", "", "stroke", 10), "ball on a beam", "m", 0.1, (500, 1000)),
    "damper": OutsideSet(LeagueSet("X", "", "y", "velocity", 10), "magnetorheological damper", "N", 5e-3, (2000, 3499)),
    "dryer": OutsideSet(LeagueSet("X", "", "y", "velocity", 10), "hot air in a tube", "V", 0.08, (500, 1000)),
}


def outside_source(name: str, folder: Path, work: Path) -> DataSource:
    """A set from outside as two recordings, estimation and test."""
    which = OUTSIDE[name]
    cut, rows = which.rows
    file = (folder / f"{name}.mat").resolve()
    parts = [f'[[recordings]]\npath = "{file}"\nname = "{n}"\nrows = [{a}, {b}]\n'
             for n, a, b in (("estimation", 0, cut), ("test", cut, rows))]  # fmt: skip
    columns = (which.machine.command, which.machine.stroke or which.machine.velocity)
    channels = [f'{column} = {{ column = "{column}" }}' for column in columns]
    text = "\n".join([*parts, f"[map]\nsample_time_s = {which.sample_time_s}\n[map.channels]", *channels])
    (work / f"{name}.toml").write_text(text + "\n")
    return DataSource.of(work / f"{name}.toml")


def machine(recording: Recording, which: LeagueSet) -> Recording:
    """The recording with the channels of one actuator."""
    columns, channels = [recording.column(which.command)], [Channel("command", Kind.RATIO)]
    channels.append(Channel("velocity", Kind.VELOCITY))
    if which.velocity:
        columns.append(recording.column(which.velocity))
    else:
        stroke = recording.column(which.stroke).astype(np.float64)
        columns += [np.diff(stroke, prepend=stroke[:1]) * recording.rate_hz, stroke]
        channels.append(Channel("stroke", Kind.POSITION))
    values = np.stack(columns, axis=1).astype(np.float32)
    return Recording(recording.name, tuple(channels), values, recording.rate_hz, recording.source)


def column_of(channels: TwinChannels, target: str) -> int:
    """Column of the answer that is scored."""
    return [channel.name for channel in channels.answers].index(target)


def free_run_rmse(twin: Twin, part: Series, target: str) -> float:
    """Error of one free run through a whole stretch, behind the prefix."""
    prefix, column = twin.prefix_ticks, column_of(twin.channels, target)
    state = twin.reset(part.inputs[None, :prefix], part.targets[None, :prefix])
    answers, _ = twin.rollout(part.inputs[None, prefix:-1], state)
    error = answers[0, :, column].astype(np.float64) - part.targets[prefix + 1 :, column]
    return float(np.sqrt(np.square(error).mean()))


@dataclass(frozen=True, eq=False)
class Judged:
    """Estimation and test data of a set as series of a twin; the choice may take so many minutes (0: any)."""

    channels: TwinChannels
    estimation: Series
    test: Series
    which: LeagueSet
    minutes: float

    @staticmethod
    def of(source: DataSource, which: LeagueSet, minutes: float) -> Judged:
        """From the two recordings of a set."""
        estimation, test = (machine(recording, which) for recording in source.read())
        channels = twin_channels(estimation)
        task = channels.task()
        return Judged(channels, task.series(estimation), task.series(test), which, minutes)

    def experiment(self, seed: int, quick: bool) -> TwinExperiment:
        """The defaults, the budget, the prefix of the league, and the elements that the description names."""
        made = load_twin_experiment(None, (f"training.seed={seed}", *(QUICK if quick else ())))
        elements = self.which.elements
        if quick and elements is not None:
            elements = replace(elements, starts=1, rounds=2)
        made = replace(made, twin=replace(made.twin, prefix_ticks=self.which.prefix_ticks, elements=elements))
        return with_budget(made, self.minutes) if self.minutes else made

    def chosen(self, seed: int, quick: bool) -> tuple[FittedFormulation, dict[str, Any], TwinExperiment]:
        """The twin that the defaults choose, and what was tried."""
        experiment, cut = self.experiment(seed, quick), round(ESTIMATION * self.estimation.samples)
        parts = [
            replace(self.estimation, inputs=self.estimation.inputs[rows], targets=self.estimation.targets[rows])
            for rows in (slice(0, cut), slice(cut, None))
        ]
        data: Any = StretchFold(parts[:1], parts[1:])
        scales = fit_scales(self.channels, parts[:1])
        with tempfile.TemporaryDirectory() as folder, Run(folder) as run:
            fit = TwinFit(self.channels, scales, data, experiment)
            result, tried = TwinChoice(fit, experiment.twin, KeyedRun(run, "0" * 32)).best()
        facts = {"chosen": next(one.label for one in tried if one.chosen), "candidates": [one.row() for one in tried]}
        return result, facts, experiment

    def rivals(self, seed: int) -> dict[str, float]:
        """Errors of what is fitted to the same data in the same run."""
        prefix, target = self.which.prefix_ticks, self.which.target
        scales, found = fit_scales(self.channels, [self.estimation]), {}
        for name in RIVALS:
            spec = replace(TWINS[name](), prefix_ticks=prefix)
            rival = spec.start(self.channels, scales, [self.estimation], seed)
            found[name] = free_run_rmse(rival, self.test, target)
        column = column_of(self.channels, target)
        pairs = [(part.inputs.astype(np.float64), part.targets[:, column].astype(np.float64))
                 for part in (self.estimation, self.test)]  # fmt: skip
        narx = fit_narx(*pairs[0], prefix, seed)
        # As late a start as the twin's: what is measured before is told to all.
        begin = prefix + 1 - narx.lags
        said = narx.free_run(pairs[1][0][begin:], pairs[1][1][begin:])
        error = said - pairs[1][1][prefix + 1 :]
        return found | {"narx": float(np.sqrt(np.square(error).mean()))}

    def coverage(self, result: FittedFormulation, experiment: TwinExperiment) -> list[dict[str, Any]]:
        """Share of free runs along the test recording that the intervals hold, by horizon."""
        shortest, longest = 1.0 / self.channels.rate_hz, self.test.samples / self.channels.rate_hz
        twin, judge = result.fitted.twin, experiment.judge
        intervals = calibrated(result.unseen or ((twin, [self.estimation]),), judge)
        part = "strokes" if self.which.target == "stroke" else "velocities"
        rows = []
        for at in sorted({max(at, shortest) for at in judge.covered_at_s if at < HALF * longest}):
            # Runs as long as each horizon, so that starts lie all along the recording.
            runs = free_runs(twin, [self.test], at, STARTS)
            row = coverage_of(runs, replace(judge, covered_at_s=(at,)), intervals)["at"][0]
            rows.append({"at_s": at, "calibrated": row["calibrated"], "share": row[part]["share"]})
        return rows

    def measure(self, seed: int, quick: bool) -> dict[str, Any]:
        """The chosen twin of a seed: error in the unit of the set, what was chosen, coverage, processor time."""
        began = time.process_time()
        result, facts, experiment = self.chosen(seed, quick)
        error = free_run_rmse(result.fitted.twin, self.test, self.which.target)
        facts |= {"error": error, "coverage": self.coverage(result, experiment), "minutes": self.minutes}
        facts |= {"environment": environment(0)}
        return facts | {"processor_s": round(time.process_time() - began, 1)}


def summary(judged: Judged, seeds: Sequence[int], factor: float, quick: bool, work: Path, name: str) -> dict[str, Any]:
    """All seeds of a set, in the unit of its table, and its rivals."""
    form = "_quick" if quick else ""
    rows = {}
    for seed in seeds:
        file = work / f"{name}_{seed}{form}.json"
        rows[seed] = kept(file, lambda seed=seed: judged.measure(seed, quick))
        if rows[seed]["minutes"] != judged.minutes:
            raise SystemExit(
                f"{file} was measured with --minutes {rows[seed]['minutes']:g}, and {judged.minutes:g} were asked "
                "for: give these, or another --work folder"
            )
    rivals = kept(work / f"{name}_rivals.json", lambda: judged.rivals(seeds[0]))
    ours = {seed: factor * row["error"] for seed, row in rows.items()}
    return {
        "ours": ours,
        "median": statistics.median(ours.values()),
        "rivals": {rival: factor * error for rival, error in rivals.items()},
        "seeds": {seed: {k: v for k, v in row.items() if k != "error"} for seed, row in rows.items()},
        "processor_s": sum(row["processor_s"] for row in rows.values()),
    }


def show(title: str, found: dict[str, Any], published: dict[str, float]) -> None:
    """Print a table of a set."""
    print(f"\nFree run of the default twin: {title}")
    rows = [*published.items(), ("TWIN", found["median"]), *((f"{n}, here", e) for n, e in found["rivals"].items())]
    table(["method", "test RMSE"], sorted(rows, key=lambda pair: pair[1]))
    for seed, row in found["seeds"].items():
        held = ", ".join(f"{one['share']:.0%} at {one['at_s']:g} s" for one in row["coverage"])
        print(f"seed {seed}: {found['ours'][seed]:.4g}; {row['chosen']}; intervals of 90 % hold {held}")


def against_goal(title: str, data: str, found: dict[str, Any], unit: str, quick: bool) -> Verdict:
    """Compare the median error with the goal that was set for this data set."""
    return verdict(f"{title}: twin against its goal", found["median"], GOALS[data], "<= 1", unit, quick)


def against_rivals(title: str, found: dict[str, Any], unit: str, quick: bool) -> Verdict:
    """The twin beside the best of its rivals."""
    best = min(found["rivals"], key=lambda rival: float(found["rivals"][rival]))
    return verdict(f"{title}: twin against {best}", found["median"], found["rivals"][best], "<= 1", unit, quick)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    options = parser(__doc__ or "")
    options.add_argument("--shared", type=Path, default=None, help=f"folder of the recordings (else ${VARIABLE})")
    options.add_argument("--outside", type=Path, default=None, help="folder of the sets from outside; else left out")
    options.add_argument("--seeds", type=int, default=5)
    options.add_argument(
        "--minutes", nargs="*", default=[], help="as of edp twin, for all or as tanks=1; else no bound"
    )
    options.add_argument("--only", nargs="*", default=None, help="sets by name, such as tanks or drive")
    options.add_argument("--work", type=Path, default=None, help="folder that keeps what is finished")
    given = options.parse_args(arguments)
    if shared_folder(given.shared) is None:
        return
    in_folder(given.work, lambda work: run(given, work))


def minutes_of(given: Sequence[str], name: str) -> float:
    """Budget of a set: its own, else that of all, else none."""
    own = dict(text.split("=") if "=" in text else ("", text) for text in given)
    return float(own.get(name, own.get("", 0.0)))


def run(given: Any, work: Path) -> None:
    """All sets that were asked for."""
    seeds = range(given.seed, given.seed + (1 if given.quick else given.seeds))
    verdicts: list[Verdict] = []
    details: dict[str, Any] = {}
    for entry in read_toml(EXAMPLES / "leagues.toml")["leagues"]:
        name = Path(entry["data"]).stem
        if given.only is not None and name not in given.only:
            continue
        judged = Judged.of(
            DataSource.of(EXAMPLES / entry["data"]), SETS[entry["data"]], minutes_of(given.minutes, name)
        )
        factor = 1000.0 if entry["unit"] == "mm" else 1.0
        found = summary(judged, seeds, factor, given.quick, work, name)
        show(entry["title"], found, entry["published"])
        verdicts += [*verdicts_of(entry, found, given.quick, ", twin"),
                     against_goal(entry["title"], entry["data"], found, entry["unit"], given.quick),
                     against_rivals(entry["title"], found, entry["unit"], given.quick)]  # fmt: skip
        details[entry["title"]] = found
    for name, which in OUTSIDE.items() if given.outside else ():
        if given.only is not None and name not in given.only:
            continue
        judged = Judged.of(outside_source(name, given.outside, work), which.machine, minutes_of(given.minutes, name))
        title = f"{which.what} ({name})"
        found = summary(judged, seeds, 1.0, given.quick, work, name)
        show(title, found, {})
        verdicts.append(against_rivals(title, found, which.unit, given.quick))
        details[title] = found
    # A part of the sets takes no whole result's place.
    finish("twin_leagues" if given.only is None else "twin_leagues_part", verdicts, given.seed, details)


if __name__ == "__main__":
    main()
