"""What `edp train --preset auto` chose: the error that left-out data promised beside that of the test recordings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from edp.errors import StorageError, count_of
from edp.report.run.facts import NETWORK, Facts, Target, horizon_text, label_of, score
from edp.report.run.figures import horizons_shown
from edp.storage import read_object, write_json
from edp.storage.paths import is_file_at
from edp.table import Column, Table
from edp.wording import MISSING, decimals_for, number, percent

FILE = "auto.json"
FLOOR, PERSISTENCE = "linear", "persistence"
"""What a skill is relative to: the candidate whose bundle lies in a folder of this name, or the present value."""


def read_choice(folder: Path) -> Mapping[str, Any] | None:
    """The content of ``auto.json``; None where the run is another.

    Raises:
        StorageError: the file does not hold what the preset auto writes.
    """
    path = folder / FILE
    if not is_file_at(path):
        return None
    content = read_object(path, ("key", "sentence", "minutes", "chosen", "candidates", "excess", "persistence"))
    candidates, excess = content["candidates"], content["excess"]
    sound = (
        isinstance(content["sentence"], str)
        and isinstance(content.get("notes", []), list)
        and all(isinstance(note, str) for note in content.get("notes", []))
        and isinstance(content["key"], str)
        and isinstance(content["minutes"], int | float)
        and isinstance(candidates, dict)
        and isinstance(excess, dict)
        and isinstance(content["chosen"], str)
        and content["chosen"] in candidates
        and all(_is_candidate(one) for one in candidates.values())
        and all(isinstance(excess.get(name), int | float) for name in candidates)
        and all(_is_promise(one.get("promise")) for one in candidates.values())
        and _is_promise(content["persistence"])
        and _is_interval(content.get("interval", {"low": {}, "high": {}}))
        and _is_skill(content.get("skill"))
    )
    if not sound:
        raise StorageError(f"'{path}' does not hold what edp train --preset auto writes; train again in another folder")
    return content


def note_test_result(folder: Path, scores: Mapping[str, Any], floor: Mapping[str, Any] | None = None) -> None:
    """Write what every model reached into ``auto.json``, where a run has one.

    Args:
        folder: the run folder.
        scores: the content of its ``scores.json``: of the kept model and of each baseline.
        floor: scores of the linear candidate on the same ticks; None where the run left none.

    Raises:
        StorageError: the file does not hold what the preset auto writes, or cannot be written.
    """
    content = read_choice(folder)
    if content is None:
        return
    results = {
        name: {"label": model["label"], "test": _errors(model["overall"])}
        | ({"validation": _errors(model["validation"])} if "validation" in model else {})
        for name, model in scores["models"].items()
    }
    against = scores["models"].get(PERSISTENCE) if floor is None else floor
    skill = content.get("skill")
    if skill and against and (floor is not None) == (skill["against"] == FLOOR):
        skill = {**skill, "test": _ratios(results[NETWORK]["test"], _errors(against["overall"]))}
    write_json(folder / FILE, {**content, "results": results, **({"skill": skill} if skill else {})})


def _ratios(
    errors: Mapping[str, Mapping[str, float]], below: Mapping[str, Mapping[str, float]]
) -> dict[str, dict[str, float]]:
    """Of errors, where the lower one is not zero."""
    return {
        k: {name: error / below[k][name] for name, error in row.items() if below.get(k, {}).get(name, 0.0) > 0}
        for k, row in errors.items()
    }


def _errors(overall: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Root-mean-square errors by horizon and target."""
    return {
        k: {name: metrics["rmse"] for name, metrics in targets.items() if name != "mean"}
        for k, targets in overall.items()
    }


def _is_candidate(value: Any) -> bool:
    """Whether a value is what is known of a candidate."""
    return (
        isinstance(value, dict)
        and isinstance(value.get("label"), str)
        and isinstance(value.get("parameters"), int)
        and isinstance(value.get("seconds"), int | float)
    )


def _is_promise(value: Any) -> bool:
    """Whether a value is errors by horizon and target."""
    return isinstance(value, dict) and all(
        isinstance(row, dict) and all(isinstance(error, int | float) for error in row.values())
        for row in value.values()
    )


def _is_interval(value: Any) -> bool:
    """Whether a value is bounds by horizon and target."""
    return isinstance(value, dict) and all(_is_promise(value.get(side)) for side in ("low", "high"))


def _is_skill(value: Any) -> bool:
    """Whether a value is errors relative to another model, promised and measured; runs before version 0.2 have none."""
    return value is None or (
        isinstance(value, dict)
        and value.get("against") in (FLOOR, PERSISTENCE)
        and _is_promise(value.get("promise"))
        and _is_interval(value.get("interval"))
        and _is_promise(value.get("test", {}))
    )


def candidates_table(content: Mapping[str, Any]) -> Table:
    """Each candidate's error on left-out data relative to the one that is kept."""
    chosen = content["chosen"]
    rows = []
    for name, one in content["candidates"].items():
        # expm1: excess is a difference of logarithms, and the share is its exponential less one.
        share = math.expm1(float(content["excess"][name]) - float(content["excess"][chosen]))
        rows.append((one["label"], f"{one['parameters']:,}", "kept" if name == chosen else percent(share, signed=True)))
    marked = frozenset(row for row, name in enumerate(content["candidates"]) if name == chosen)
    columns = (Column("Model"), Column("Parameters"), Column("Error on left-out data", "against the one kept"))
    return Table("The models that were tried", columns, tuple(rows), marked)


def model_tables(facts: Facts, content: Mapping[str, Any]) -> list[Table]:
    """Every model that was tried and every baseline, a table an output: left-out data beside the test recordings.

    A candidate's error on left-out data is its cross-validated promise, a baseline's is that on the validation part,
    which also chose its sizes. Only the model that is kept has met the test recordings.
    """
    return [table for table in (_of_output(facts, content, target) for target in facts.targets) if table.rows]


def _of_output(facts: Facts, content: Mapping[str, Any], target: Target) -> Table:
    horizons = horizons_shown(facts)
    chosen = content["chosen"]

    def tested(name: str, k: int) -> float | None:
        return score(facts.models.get(name, {}), k, "rmse", target.name)

    def validated(name: str, k: int) -> float | None:
        model = facts.models[name]
        return score({"overall": model.get("validation", {})}, k, "rmse", target.name)

    def row(label: str, pairs: list[tuple[float | None, float | None]]) -> tuple[str, list[float | None]]:
        return label, [value for pair in pairs for value in pair]

    rows = []
    for name, one in content["candidates"].items():
        promised = [one["promise"].get(str(k), {}).get(target.name) for k in horizons]
        tests = [tested(NETWORK, k) if name == chosen else None for k in horizons]
        rows.append(row(one["label"], list(zip(promised, tests, strict=True))))
    for name in facts.models:
        if name != NETWORK:
            rows.append(row(label_of(facts, name), [(validated(name, k), tested(name, k)) for k in horizons]))
    places = [decimals_for(values[column] for _, values in rows) for column in range(2 * len(horizons))]
    cells = tuple(
        (label, *(number(value, decimals) for value, decimals in zip(values, places, strict=True)))
        for label, values in rows
    )
    marked = frozenset(index for index, name in enumerate(content["candidates"]) if name == chosen)
    columns = [Column("Model")]
    for k in horizons:
        columns += [
            Column(f"{horizon_text(facts, k)} ahead, {part}", target.unit) for part in ("left-out data", "test")
        ]
    caption = f"{target.description}: RMSE of every model on left-out data and on the test recordings"
    return Table(caption, tuple(columns), cells, marked)


def promise_table(facts: Facts, content: Mapping[str, Any]) -> Table | None:
    """By output and horizon the error promised and that on the test recordings, both beside a simple model's."""
    promised, interval = content["candidates"][content["chosen"]]["promise"], content.get("interval")
    skill = content.get("skill") or {"against": FLOOR, "promise": {}, "interval": {"low": {}, "high": {}}}
    rows = []
    for target in facts.targets:
        for k in facts.horizons:
            expected = _at(promised, k, target.name)
            test = score(facts.models.get(NETWORK, {}), k, "rmse", target.name)
            if expected is None or test is None:
                continue
            bounds = [_at((interval or {}).get(side, {}), k, target.name) for side in ("low", "high")]
            still = _at(content["persistence"], k, target.name)
            places = decimals_for([expected, test])
            rows.append(
                (
                    f"{target.description}, {horizon_text(facts, k)} ahead",
                    target.unit,
                    _with_bounds(expected, bounds, places),
                    number(test, places),
                    percent(test / expected - 1, signed=True) if expected > 0 else MISSING,
                    _with_bounds(
                        _at(skill["promise"], k, target.name),
                        [_at(skill["interval"][side], k, target.name) for side in ("low", "high")],
                        2,
                    ),
                    number(_at(skill.get("test", {}), k, target.name), 2),
                    number(still, places),
                )
            )
    if not rows:
        return None
    beside = "Error over the linear model's" if skill["against"] == FLOOR else "Error over persistence's"
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


def promise_line(content: Mapping[str, Any]) -> str:
    """What became of the promise on the test recordings, in a sentence; empty before they were judged."""
    tested = content.get("results", {}).get(NETWORK, {}).get("test", {})
    interval, skill = content.get("interval"), content.get("skill") or {}
    if not interval or not tested:
        return ""
    inside, count = _within(tested, interval)
    cases = count_of(count, "pair")
    line = f"The promised error held on {inside} of {cases} of output and horizon (within its 90 % interval)"
    pairs = [
        (promised, skill["test"][k][name])
        for k, row in skill.get("promise", {}).items()
        for name, promised in row.items()
        if promised > 0 and skill.get("test", {}).get(k, {}).get(name, 0.0) > 0
    ]
    if not pairs:
        return f"{line}."
    # Geometric means: ratios of errors.
    promised, measured = (math.exp(sum(map(math.log, each)) / len(each)) for each in zip(*pairs, strict=True))
    beside = "the linear model's" if skill["against"] == FLOOR else "persistence's"
    return f"{line}; relative to {beside} it was promised as {promised:.2f} and is {measured:.2f}."


def _within(tested: Mapping[str, Any], interval: Mapping[str, Any]) -> tuple[int, int]:
    """How many test errors lie within their bounds, and how many have some."""
    within = [
        low <= tested[k][name] <= interval["high"][k][name]
        for k, row in interval["low"].items()
        for name, low in row.items()
        if name in tested.get(k, {}) and name in interval["high"].get(k, {})
    ]
    return sum(within), len(within)


def _at(errors: Mapping[str, Mapping[str, float]], k: int, name: str) -> float | None:
    return errors.get(str(k), {}).get(name)


def _with_bounds(value: float | None, bounds: list[float | None], places: int) -> str:
    """A number with its interval, where it has one."""
    if value is None or None in bounds:
        return number(value, places)
    return f"{number(value, places)} ({number(bounds[0], places)} to {number(bounds[1], places)})"
