"""A copy of a study's questions and answers for optuna-dashboard; the ledger stays the only truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from edp.errors import StorageError
from edp.storage.study_file import read_study, reading_parts
from edp.workflows.search.plan import space_of
from edp.workflows.search.space import Choice, Range, Space
from edp.workflows.search.study import FinishedStudy, FinishedTrial, write_journal

JOURNAL = "optuna.journal"
NO_VALUES = ("number", "values", "modules", "score", "statuses", "rungs", "pruned")


def export_study(folder: str | Path, path: str | Path | None = None) -> tuple[Path, list[str]]:
    """Write the studies of phases 1, 4 and 5 as a journal of Optuna: ``optuna-dashboard FILE`` shows them.

    Args:
        folder: of the study.
        path: of the journal; default ``optuna.journal`` in the folder. Another file there is replaced.

    Returns:
        The file, and the names of the studies in it.

    Raises:
        StorageError: no study, none of these phases has ended, or the file cannot be written.
    """
    content = read_study(folder)
    file = Path(folder, JOURNAL) if path is None else Path(path)
    with reading_parts(folder):
        studies = ended_studies(content)
    if not studies:
        raise StorageError(
            f"'{folder}' has asked no questions yet: phase 1 (calibration) has not ended; go on with edp search, then "
            "export again"
        )
    write_journal(file, studies)
    return file, [study.name for study in studies]


def ended_studies(study: Mapping[str, Any]) -> list[FinishedStudy]:
    """The studies of phases 1, 4 and 5 that have ended."""
    space = space_of(study["spec"]["space"])
    studies = []
    for decision in study["decisions"]:
        phase, facts = decision["phase"], decision["facts"]
        if phase == "calibration":
            for backbone, own in facts["backbones"].items():
                studies.append(_ended_study(f"{phase} {backbone}", own["trials"], space, [], study))
        elif phase in ("synthesis", "exploration"):
            options = {key: Choice(tuple(values)) for key, values in facts.get("options", {}).items()}
            studies.append(_ended_study(phase, facts["trials"], {**space, **options}, list(facts["on"]), study))
    return studies


def _ended_study(
    name: str, trials: Sequence[Mapping[str, Any]], space: Space, modules: Sequence[str], study: Mapping[str, Any]
) -> FinishedStudy:
    # A viewer shows objectives without units; the names carry them.
    cost, score = study["spec"]["cost"], f"composite, {study['unit']}"
    full: dict[str, Range] = dict(space) | {module: Choice((0, 1)) for module in modules}
    objectives = (score,) if cost == "none" else (score, cost)
    rows = []
    for trial in trials:
        # Options of modules that were off are absent, switches are always there.
        values = dict(trial["values"]) | {module: int(module in trial.get("modules", ())) for module in modules}
        trial_score = trial["score"]
        answer = None if trial_score is None else [trial_score] if cost == "none" else [trial_score, trial[cost]]
        attributes = {key: value for key, value in trial.items() if key not in NO_VALUES}
        # Pruned questions keep their reports, which the viewer draws as curves.
        reports = {int(step): float(value) for step, value in trial.get("rungs", ())}
        rows.append(FinishedTrial(values, answer, attributes, reports, bool(trial.get("pruned"))))
    return FinishedStudy(name, full, rows, objectives)
