"""How good is the default twin on recordings that other people made, in free run on commands alone?

Each set is a machine with one actuator: a command, and a velocity (backward difference of the position or level) with
its integral. Where what is scored does not integrate anything (the pressure of the arm, the speed of a drive), it
stands in the place of the velocity, alone. The twin is what `edp twin` chooses without settings from the estimation
data; where the description of a set names its parts (two tanks, an axis with a drive), these elements are one more
candidate. It is measured for a few ticks and then runs on the commands through the whole test recording.

The leagues have their leaders beside it, and all sets the static map, ARX, a subspace model and a NARX model, fitted in
the same run to the same estimation data.

The recordings are no part of the repository: their folder is given by --shared or EDP_SHARED_DATA.
--work keeps what is finished, so that a run may be stopped, and divided: each part is a run
of its own with --only and --seed, also on another machine, all with one --work folder (or with folders whose files are
put together); a last run over all sets and seeds with that folder reads them, and gives the tables.
"""

from __future__ import annotations

import statistics
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common import EXAMPLES, SHARED, WORK, Bench, benchmark, kept, option, table
from edp.config.twin import TwinExperiment, limit_processor_time, load_twin_experiment
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

ESTIMATION = 0.8
"""Share of the estimation data that trains where nothing is left out in turn; the rest chooses."""
RIVALS = ("static", "arx", "n4sid")
QUICK = ("training.updates=[20,20,20,20]", "training.batch=16")
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


def machine(recording: Recording, which: LeagueSet) -> Recording:
    """Return the recording with the channels of one actuator."""
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


Doubles = NDArray[np.float64]
FORMS = (("polynomial", 2), ("polynomial", 4), ("perceptron", 4), ("perceptron", 10))
"""Form and lags that are tried."""
CHOOSES = 0.2
"""Share of the estimation data that chooses."""
PENALTY = 1e-4
HIDDEN = 16


@dataclass(frozen=True, eq=False)
class Narx:
    """NARX model: ``say`` maps scaled rows of lags to the scaled answer one tick later."""

    label: str
    lags: int
    say: Callable[[Doubles], Doubles]
    offset: Doubles
    width: Doubles
    low: float
    high: float

    def free_run(self, commands: Doubles, answers: Doubles) -> Doubles:
        """Answers from tick `lags` on, by commands ``(tick, command)`` and the first answers ``(lags,)``."""
        said = list(answers[: self.lags])
        u = (commands - self.offset[:-1]) / self.width[:-1]
        for t in range(self.lags, len(commands)):
            y = (np.array(said[-self.lags :]) - self.offset[-1]) / self.width[-1]
            row = np.concatenate([u[t - self.lags : t].ravel(), y])
            value = float(self.say(row[None])[0]) * self.width[-1] + self.offset[-1]
            said.append(min(max(value, self.low), self.high))
        return np.array(said[self.lags :])


def fit_narx(commands: Doubles, answers: Doubles, prefix: int, seed: int) -> Narx:
    """Fit what a textbook on system identification would try next to ARX and subspace models.

    Polynomials of second degree and perceptrons with one hidden layer read the last commands and answers, are fitted
    one tick ahead, and are fed with their own answers, kept within the range that was seen, widened by a quarter to
    each side. Lags and form are those with the least error of a free run through the last fifth; the choice is fitted
    to all data.
    """
    cut = round((1.0 - CHOOSES) * len(answers))
    errors = {}
    for form, lags in FORMS:
        if lags > prefix:
            continue
        model = _fitted(form, lags, commands[:cut], answers[:cut], seed)
        with np.errstate(all="ignore"):
            said = model.free_run(commands[cut:], answers[cut:])
        errors[form, lags] = float(np.square(said - answers[cut + lags :]).mean())
    form, lags = min(errors, key=lambda one: errors[one])
    return _fitted(form, lags, commands, answers, seed)


def _fitted(form: str, lags: int, commands: Doubles, answers: Doubles, seed: int) -> Narx:
    whole = np.concatenate([commands, answers[:, None]], axis=1)
    offset, width = whole.mean(axis=0), np.maximum(whole.std(axis=0), 1e-9)
    scaled = (whole - offset) / width
    ticks = range(lags, len(answers))
    rows = np.stack([np.concatenate([scaled[t - lags : t, :-1].ravel(), scaled[t - lags : t, -1]]) for t in ticks])
    say = (_polynomial if form == "polynomial" else _perceptron)(rows, scaled[lags:, -1], seed)
    reach = 0.25 * float(np.ptp(answers))
    return Narx(f"{form}, {lags} lags", lags, say, offset, width, answers.min() - reach, answers.max() + reach)


def _polynomial(rows: Doubles, goal: Doubles, seed: int) -> Callable[[Doubles], Doubles]:
    first, second = np.triu_indices(rows.shape[1])

    def spread(x: Doubles) -> Doubles:
        return np.concatenate([np.ones((len(x), 1)), x, x[:, first] * x[:, second]], axis=1)

    matrix = spread(rows)
    weights = np.linalg.solve(matrix.T @ matrix + PENALTY * len(rows) * np.eye(matrix.shape[1]), matrix.T @ goal)
    return lambda x: spread(x) @ weights


def _perceptron(rows: Doubles, goal: Doubles, seed: int) -> Callable[[Doubles], Doubles]:
    from sklearn.neural_network import MLPRegressor

    network = MLPRegressor(
        hidden_layer_sizes=(HIDDEN,), activation="tanh", solver="lbfgs", alpha=1e-3, max_iter=600, random_state=seed
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        network.fit(rows, goal)
    (w1, w2), (b1, b2) = network.coefs_, network.intercepts_

    def say(x: Doubles) -> Doubles:
        said: Any = np.tanh(x @ w1 + b1) @ w2 + b2
        return np.asarray(said)[:, 0]

    return say


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
    def from_run(source: DataSource, which: LeagueSet, minutes: float) -> Judged:
        """From the two recordings of a set."""
        estimation, test = (machine(recording, which) for recording in source.read())
        channels = twin_channels(estimation)
        task = channels.task()
        return Judged(channels, task.series(estimation), task.series(test), which, minutes)

    def experiment(self, seed: int, quick: bool) -> TwinExperiment:
        """Return the default settings with the budget, the prefix of the league, and the named elements."""
        made = load_twin_experiment(None, (f"training.seed={seed}", *(QUICK if quick else ())))
        elements = self.which.elements
        if quick and elements is not None:
            elements = replace(elements, starts=1, rounds=2)
        made = replace(made, twin=replace(made.twin, prefix_ticks=self.which.prefix_ticks, elements=elements))
        return limit_processor_time(made, self.minutes) if self.minutes else made

    def chosen(self, seed: int, quick: bool) -> tuple[FittedFormulation, dict[str, Any], TwinExperiment]:
        """Fit the twin that the defaults choose; return the twin, the candidates and the settings."""
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
        twin, judge = result.fitted.twin, experiment.evaluation
        intervals = calibrated(result.unseen or ((twin, [self.estimation]),), judge)
        part = "strokes" if self.which.target == "stroke" else "velocities"
        rows = []
        for at in sorted({max(at, shortest) for at in judge.coverage_at_s if at < HALF * longest}):
            # Runs as long as each horizon, so that starts lie all along the recording.
            runs = free_runs(twin, [self.test], at, STARTS)
            row = coverage_of(runs, replace(judge, coverage_at_s=(at,)), intervals).at[0]
            rows.append({"at_s": at, "calibrated": row.calibrated, "share": row.parts()[part].share})
        return rows

    def measure(self, seed: int, quick: bool) -> dict[str, Any]:
        """Measure the chosen twin of a seed: error in the unit of the set, formulation, coverage, processor time."""
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


def check(bench: Bench, entry: dict[str, Any], found: dict[str, Any]) -> None:
    """Compare the twin's median with each published reference, the target and the best reference of this run."""
    title, ours, unit = entry["title"], found["median"], entry["unit"]
    for name in entry["rivals"]:
        bench.check(f"{title}, twin: against the published {name}", ours, entry["published"][name], "<= 1", unit)
    bench.check(f"{title}: twin", ours, GOALS[entry["data"]], "<= 1", unit)
    best = min(found["rivals"], key=lambda rival: float(found["rivals"][rival]))
    bench.check(f"{title}: twin against {best}", ours, found["rivals"][best], "<= 1", unit)


def minutes_of(given: Sequence[str], name: str) -> float:
    """Budget of a set: its own, else that of all, else none."""
    own = dict(text.split("=") if "=" in text else ("", text) for text in given)
    return float(own.get(name, own.get("", 0.0)))


@benchmark(
    SHARED,
    WORK,
    option("--seeds", type=int, default=5),
    option("--minutes", nargs="*", default=[], help="as of edp twin, for all or as tanks=1; else no bound"),
    option("--only", nargs="*", help="sets by name, such as tanks"),
)
def main(bench: Bench) -> object:
    given, work = bench.options, bench.folder
    seeds = range(given.seed, given.seed + (1 if given.quick else given.seeds))
    details: dict[str, Any] = {}
    for entry in read_toml(EXAMPLES / "leagues.toml")["leagues"]:
        name = Path(entry["data"]).stem
        if given.only is not None and name not in given.only:
            continue
        judged = Judged.from_run(
            DataSource.from_path(EXAMPLES / entry["data"]), SETS[entry["data"]], minutes_of(given.minutes, name)
        )
        factor = 1000.0 if entry["unit"] == "mm" else 1.0
        found = summary(judged, seeds, factor, given.quick, work, name)
        show(entry["title"], found, entry["published"])
        check(bench, entry, found)
        details[entry["title"]] = found
    # A part of the sets takes no whole result's place.
    bench.keep = given.only is None
    return details


if __name__ == "__main__":
    main()
