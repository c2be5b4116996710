"""What `edp train --preset auto` chose: the error that left-out data promised beside that of the test recordings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from edp.errors import StorageError
from edp.report.common.tables import TextTable
from edp.report.common.wording import MISSING, decimals_for, number, percent
from edp.report.run.facts import NETWORK, Facts, Target, horizon_text, label_of, score
from edp.report.run.figures import horizons_shown
from edp.storage import read_object, write_json

FILE = "auto.json"


def read_choice(folder: Path) -> Mapping[str, Any] | None:
    """The content of ``auto.json``; None where the run is another.

    Raises:
        StorageError: the file does not hold what the preset auto writes.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    content = read_object(path, ("key", "sentence", "minutes", "chosen", "candidates", "excess", "persistence"))
    candidates, excess = content["candidates"], content["excess"]
    sound = (
        isinstance(content["sentence"], str)
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
    )
    if not sound:
        raise StorageError(f"'{path}' does not hold what edp train --preset auto writes; train again in another folder")
    return content


def note_test_result(folder: Path, scores: Mapping[str, Any]) -> None:
    """Write what every model reached into ``auto.json``, where a run has one.

    Args:
        folder: the run folder.
        scores: the content of its ``scores.json``: of the kept model and of each baseline.

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
    write_json(folder / FILE, {**content, "results": results})


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


def candidates_table(content: Mapping[str, Any]) -> TextTable:
    """Each candidate's error on left-out data relative to the one that is kept."""
    chosen = content["chosen"]
    rows = []
    for name, one in content["candidates"].items():
        # expm1: excess is a difference of logarithms, and the share is its exponential less one.
        share = math.expm1(float(content["excess"][name]) - float(content["excess"][chosen]))
        rows.append((one["label"], f"{one['parameters']:,}", "kept" if name == chosen else percent(share, signed=True)))
    marked = frozenset(row for row, name in enumerate(content["candidates"]) if name == chosen)
    columns = (("Model", ""), ("Parameters", ""), ("Error on left-out data", "against the one kept"))
    return TextTable("The models that were tried", columns, tuple(rows), marked)


def model_tables(facts: Facts, content: Mapping[str, Any]) -> list[TextTable]:
    """Every model that was tried and every baseline, a table an output: left-out data beside the test recordings.

    A candidate's error on left-out data is its cross-validated promise, a baseline's is that on the validation part,
    which also chose its sizes. Only the model that is kept has met the test recordings.
    """
    return [table for table in (_of_output(facts, content, target) for target in facts.targets) if table.rows]


def _of_output(facts: Facts, content: Mapping[str, Any], target: Target) -> TextTable:
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
    columns = [("Model", "")]
    for k in horizons:
        columns += [(f"{horizon_text(facts, k)} ahead, {part}", target.unit) for part in ("left-out data", "test")]
    caption = f"{target.description}: RMSE of every model on left-out data and on the test recordings"
    return TextTable(caption, tuple(columns), cells, marked)


def promise_table(facts: Facts, content: Mapping[str, Any]) -> TextTable | None:
    """Root-mean-square errors by output and horizon: promised, on the test recordings, of persistence."""
    promised = content["candidates"][content["chosen"]]["promise"]
    rows = []
    for target in facts.targets:
        for k in facts.horizons:
            expected = promised.get(str(k), {}).get(target.name)
            still = content["persistence"].get(str(k), {}).get(target.name)
            test = score(facts.models.get(NETWORK, {}), k, "rmse", target.name)
            if expected is None or test is None:
                continue
            places = decimals_for([expected, test])
            ratio = percent(test / expected - 1, signed=True) if expected > 0 else MISSING
            row = (f"{target.description}, {horizon_text(facts, k)} ahead", target.unit)
            rows.append((*row, number(expected, places), number(test, places), ratio, number(still, places)))
    if not rows:
        return None
    columns = (
        ("Output", ""),
        ("Unit", ""),
        ("Promised", "RMSE"),
        ("On the test recordings", "RMSE"),
        ("Test against promise", ""),
        ("Present value kept, left-out data", "RMSE"),
    )
    return TextTable("What left-out data promised, and what came of it", columns, tuple(rows))
