"""Copy of a study for optuna-dashboard; the ledger remains the source."""

from __future__ import annotations

from pathlib import Path

from edp.errors import StorageError
from edp.evaluation.study import StudyFile, read_study
from edp.evaluation.study_facts import CalibrationFacts, ExplorationFacts, JointFacts
from edp.workflows.search.plan import space_of
from edp.workflows.search.space import Choice
from edp.workflows.search.study import FinishedStudy, write_journal

JOURNAL = "optuna.journal"


def export_study(folder: str | Path, path: str | Path | None = None) -> tuple[Path, list[str]]:
    """Write the studies of phases 1, 4 and 5 as a journal of Optuna: ``optuna-dashboard FILE`` shows them.

    Args:
        folder: folder of the study.
        path: path of the journal; by default ``optuna.journal`` in the folder. An existing file is replaced.

    Returns:
        The file, and the names of the studies in it.

    Raises:
        StorageError: no study, none of these phases has ended, or the file cannot be written.
    """
    study = read_study(folder)
    file = Path(folder, JOURNAL) if path is None else Path(path)
    studies = list_ended_studies(study)
    if not studies:
        raise StorageError(
            f"'{folder}' has asked no questions yet: phase 1 (calibration) has not ended; go on with edp search, then "
            "export again"
        )
    write_journal(file, studies)
    return file, [one.name for one in studies]


def list_ended_studies(study: StudyFile) -> list[FinishedStudy]:
    """Return the finished studies of phases 1, 4 and 5."""
    space, cost = space_of(study.spec["space"]), study.spec["cost"]
    score = f"composite, {study.unit}"
    objectives = (score,) if cost == "none" else (score, cost)
    studies = []
    calibration = study.facts(CalibrationFacts)
    for backbone, own in calibration.backbones.items() if calibration is not None else ():
        studies.append(FinishedStudy(f"calibration {backbone}", space, (), own.trials, objectives))
    for decision in study.decisions:
        if isinstance(decision.facts, JointFacts):
            facts = decision.facts
            options = facts.options if isinstance(facts, ExplorationFacts) else {}
            own_space = {**space, **{name: Choice(tuple(values)) for name, values in options.items()}}
            studies.append(FinishedStudy(decision.phase, own_space, tuple(facts.on), facts.trials, objectives))
    return studies
