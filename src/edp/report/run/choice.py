"""Choice of `edp train --preset auto`: expected error on left-out data and error on the test recordings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from edp.errors import ConfigError, count_of
from edp.evaluation.scores_file import MEAN, ByHorizon, ModelScores, ScoredTarget, ScoresFile, error_at, metric
from edp.report.run.facts import NETWORK, Facts, horizon_text, label_of, score
from edp.report.run.figures import horizons_shown
from edp.settings.results import ResultFile
from edp.storage.paths import is_file_at
from edp.table import Column, Table
from edp.wording import MISSING, decimals_for, number, percent

FLOOR, PERSISTENCE = "linear", "persistence"
"""References of a skill score: the candidate whose bundle folder has this name, or the present value."""
Errors = Mapping[str, Mapping[str, float]]
"""Root-mean-square errors by horizon and target."""


@dataclass(frozen=True, kw_only=True)
class ErrorBounds:
    """Ends of the 90 % intervals of errors."""

    low: Errors
    high: Errors


@dataclass(frozen=True, kw_only=True)
class AutoCandidate:
    """Trained model with its cross-validated errors (`promise`)."""

    label: str
    seconds: float
    parameters: int
    promise: Errors


@dataclass(frozen=True, kw_only=True)
class Skill:
    """Errors relative to a simple model (`FLOOR` or `PERSISTENCE`).

    Attributes:
        against: the simple model.
        promise: cross-validated.
        interval: interval of the expected skill.
        test: skill on the test recordings; empty before an evaluation.
    """

    against: str
    promise: Errors
    interval: ErrorBounds
    test: Errors = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.against not in (FLOOR, PERSISTENCE):
            raise ConfigError(f"against = '{self.against[:40]}': expected '{FLOOR}' or '{PERSISTENCE}'")


@dataclass(frozen=True, kw_only=True)
class TestedModel:
    """Errors of a model on the test recordings, and of a baseline on the validation part."""

    label: str
    test: Errors
    validation: Errors = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class AutoChoice(ResultFile):
    """Content of ``auto.json``: the choice of the preset auto.

    Attributes:
        minutes: budget of processor time.
        rows: training samples.
        chosen: name of the candidate that is kept.
        best: name of the candidate with the least error.
        excess: mean logarithm of each candidate's error over the least.
        doubt: standard error of `excess`.
        sentence: the choice in words.
        candidates: candidates by name.
        persistence: errors of the present value on left-out data.
        interval: interval of the errors of the chosen candidate; None in files of earlier versions, like `skill`.
        failed: messages of candidates that diverged.
        key: key of the run.
        notes: remarks for the reader.
        results: errors on the test recordings by name of a model; empty before an evaluation.
    """

    NAME = "auto.json"
    SCHEMA = 1
    WHAT = "choice"
    ADVICE = "train again in another folder"

    minutes: float
    rows: int | None = None
    chosen: str
    best: str | None = None
    excess: Mapping[str, float]
    doubt: Mapping[str, float] | None = None
    sentence: str
    candidates: Mapping[str, AutoCandidate]
    persistence: Errors
    interval: ErrorBounds | None = None
    skill: Skill | None = None
    failed: Mapping[str, str] | None = None
    key: str
    notes: tuple[str, ...] | None = None
    results: Mapping[str, TestedModel] = field(default_factory=dict)

    def __post_init__(self) -> None:
        lacking = sorted({self.chosen, *self.candidates} - (self.candidates.keys() & self.excess.keys()))
        if lacking:
            raise ConfigError(f"candidate '{lacking[0][:40]}' lacks its errors")


def read_choice(folder: Path) -> AutoChoice | None:
    """Return the choice of the preset auto; None for another run.

    Raises:
        StorageError: the file does not hold what the preset auto writes.
    """
    return AutoChoice.read(folder) if is_file_at(folder / AutoChoice.NAME) else None


def note_test_result(folder: Path, scores: ScoresFile, floor: ModelScores | None = None) -> None:
    """Write the errors of every model on the test recordings into ``auto.json``, if the run has one.

    Args:
        folder: the run folder.
        scores: scores of the chosen model and of each baseline.
        floor: scores of the linear candidate on the same samples; None if the run has none.

    Raises:
        StorageError: the file does not hold what the preset auto writes, or cannot be written.
    """
    choice = read_choice(folder)
    if choice is None:
        return
    results = {
        name: TestedModel(label=model.label, test=_errors(model.overall), validation=_errors(model.validation))
        for name, model in scores.models.items()
    }
    against = scores.models.get(PERSISTENCE) if floor is None else floor
    skill = choice.skill
    if skill and against and (floor is not None) == (skill.against == FLOOR):
        skill = replace(skill, test=_ratios(results[NETWORK].test, _errors(against.overall)))
    replace(choice, results=results, skill=skill).write(folder)


def _ratios(errors: Errors, below: Errors) -> Errors:
    """Return ratios of errors, for denominators above zero."""
    return {
        k: {name: error / below[k][name] for name, error in row.items() if below.get(k, {}).get(name, 0.0) > 0}
        for k, row in errors.items()
    }


def _errors(overall: ByHorizon) -> Errors:
    """Return the root-mean-square errors by horizon and target."""
    return {
        k: {name: metric(metrics, "rmse") for name, metrics in targets.items() if name != MEAN}
        for k, targets in overall.items()
    }


def candidates_table(choice: AutoChoice) -> Table:
    """Return each candidate's error on left-out data relative to the chosen one."""
    chosen, excess = choice.chosen, choice.excess
    rows = []
    for name, one in choice.candidates.items():
        # expm1: excess is a difference of logarithms, and the share is its exponential less one.
        share = math.expm1(excess[name] - excess[chosen])
        rows.append((one.label, f"{one.parameters:,}", "kept" if name == chosen else percent(share, signed=True)))
    marked = frozenset(row for row, name in enumerate(choice.candidates) if name == chosen)
    columns = (Column("Model"), Column("Parameters"), Column("Error on left-out data", "against the one kept"))
    return Table("The models that were tried", columns, tuple(rows), marked)


def model_tables(facts: Facts, choice: AutoChoice) -> list[Table]:
    """Return one table per output: every candidate and baseline, on left-out data and on the test recordings.

    A candidate's error on left-out data is its cross-validated expected error, a baseline's is that on the validation
    part, which also chose its sizes. Only the model that is kept has met the test recordings.
    """
    return [table for table in (_tabulate_output(facts, choice, target) for target in facts.targets) if table.rows]


def _tabulate_output(facts: Facts, choice: AutoChoice, target: ScoredTarget) -> Table:
    horizons, chosen = horizons_shown(facts), choice.chosen

    def tested(name: str, k: int) -> float | None:
        return score(facts.models.get(name), k, "rmse", target.name)

    def validated(name: str, k: int) -> float | None:
        return error_at(facts.models[name].validation, k, target.name, "rmse")

    def row(label: str, pairs: list[tuple[float | None, float | None]]) -> tuple[str, list[float | None]]:
        return label, [value for pair in pairs for value in pair]

    rows = []
    for name, one in choice.candidates.items():
        promised = [one.promise.get(str(k), {}).get(target.name) for k in horizons]
        tests = [tested(NETWORK, k) if name == chosen else None for k in horizons]
        rows.append(row(one.label, list(zip(promised, tests, strict=True))))
    for name in facts.models:
        if name != NETWORK:
            rows.append(row(label_of(facts, name), [(validated(name, k), tested(name, k)) for k in horizons]))
    places = [decimals_for(values[column] for _, values in rows) for column in range(2 * len(horizons))]
    cells = tuple(
        (label, *(number(value, decimals) for value, decimals in zip(values, places, strict=True)))
        for label, values in rows
    )
    marked = frozenset(index for index, name in enumerate(choice.candidates) if name == chosen)
    columns = [Column("Model")]
    for k in horizons:
        columns += [
            Column(f"{horizon_text(facts, k)} ahead, {part}", target.unit) for part in ("left-out data", "test")
        ]
    caption = f"{target.description}: RMSE of every model on left-out data and on the test recordings"
    return Table(caption, tuple(columns), cells, marked)


def promise_table(facts: Facts, choice: AutoChoice) -> Table | None:
    """Return expected and test errors by output and horizon, next to the errors of a simple model."""
    promised, unknown = choice.candidates[choice.chosen].promise, ErrorBounds(low={}, high={})
    interval = choice.interval or unknown
    skill = choice.skill or Skill(against=FLOOR, promise={}, interval=unknown)
    rows = []
    for target in facts.targets:
        for k in facts.horizons:
            expected = _read_score(promised, k, target.name)
            test = score(facts.models.get(NETWORK), k, "rmse", target.name)
            if expected is None or test is None:
                continue
            bounds = [_read_score(side, k, target.name) for side in (interval.low, interval.high)]
            still = _read_score(choice.persistence, k, target.name)
            places = decimals_for([expected, test])
            rows.append(
                (
                    f"{target.description}, {horizon_text(facts, k)} ahead",
                    target.unit,
                    _add_bounds(expected, bounds, places),
                    number(test, places),
                    percent(test / expected - 1, signed=True) if expected > 0 else MISSING,
                    _add_bounds(
                        _read_score(skill.promise, k, target.name),
                        [_read_score(side, k, target.name) for side in (skill.interval.low, skill.interval.high)],
                        2,
                    ),
                    number(_read_score(skill.test, k, target.name), 2),
                    number(still, places),
                )
            )
    if not rows:
        return None
    beside = "Error over the linear model's" if skill.against == FLOOR else "Error over persistence's"
    columns = (
        Column("Output"),
        Column("Unit"),
        Column("Promised (90 % of tests)", "RMSE"),
        Column("On the test recordings", "RMSE"),
        Column("Test against promise"),
        Column(f"{beside}, promised (90 %)"),
        Column("the same, test"),
        Column("Present value kept, left-out data", "RMSE"),
    )
    return Table("What left-out data promised, and what came of it", columns, tuple(rows))


def promise_line(choice: AutoChoice) -> str:
    """State the expected error against the errors on the test recordings; empty before they were evaluated."""
    tested = choice.results[NETWORK].test if NETWORK in choice.results else {}
    skill = choice.skill
    if choice.interval is None or not tested:
        return ""
    inside, count = _count_within(tested, choice.interval)
    cases = count_of(count, "pair")
    line = f"The promised error held on {inside} of {cases} of output and horizon (within its 90 % interval)"
    pairs = [
        (promised, skill.test[k][name])
        for k, row in (skill.promise if skill else {}).items()
        for name, promised in row.items()
        if skill and promised > 0 and skill.test.get(k, {}).get(name, 0.0) > 0
    ]
    if not skill or not pairs:
        return f"{line}."
    # Geometric means: ratios of errors.
    promised, measured = (math.exp(sum(map(math.log, each)) / len(each)) for each in zip(*pairs, strict=True))
    beside = "the linear model's" if skill.against == FLOOR else "persistence's"
    return f"{line}; relative to {beside} it was promised as {promised:.2f} and is {measured:.2f}."


def _count_within(tested: Errors, interval: ErrorBounds) -> tuple[int, int]:
    """Return how many test errors lie within their bounds, and how many have some."""
    within = [
        low <= tested[k][name] <= interval.high[k][name]
        for k, row in interval.low.items()
        for name, low in row.items()
        if name in tested.get(k, {}) and name in interval.high.get(k, {})
    ]
    return sum(within), len(within)


def _read_score(errors: Errors, k: int, name: str) -> float | None:
    return errors.get(str(k), {}).get(name)


def _add_bounds(value: float | None, bounds: list[float | None], places: int) -> str:
    """Return a number with its interval, if it has one."""
    if value is None or None in bounds:
        return number(value, places)
    return f"{number(value, places)} ({number(bounds[0], places)} to {number(bounds[1], places)})"
