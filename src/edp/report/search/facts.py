"""Access of pages, pictures and tables to the data of a model search (`edp.evaluation.study`)."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import wraps
from typing import TypeVar

from edp.errors import StorageError
from edp.evaluation.study import StudyFile

Facts = TypeVar("Facts")
Made = TypeVar("Made")
Absent = TypeVar("Absent")


def require_phase(
    kind: type[Facts], absent: Absent
) -> Callable[[Callable[[StudyFile, Facts], Made]], Callable[[StudyFile], Made | Absent]]:
    """Convert a function of a study and a phase's data to a function of a study, with `absent` before the decision."""

    def wrap(function: Callable[[StudyFile, Facts], Made]) -> Callable[[StudyFile], Made | Absent]:
        @wraps(function)
        def call(study: StudyFile) -> Made | Absent:
            facts = study.facts(kind)
            return absent if facts is None else function(study, facts)

        return call

    return wrap


def finite(value: float | None) -> float | None:
    """Return a number; None if it is absent or not finite."""
    return None if value is None or not math.isfinite(value) else value


def reading(where: str, read: Callable[[], Made]) -> Made:
    """Return what `read` returns.

    Raises:
        StorageError: parts of the study contradict one another.
    """
    try:
        return read()
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        what = f"it lacks {error}" if isinstance(error, KeyError) else f"it cannot be read: {error}"
        raise StorageError(
            f"{where}: {what}; another version of EDP wrote it, or it was edited. Call `edp search` on the study "
            "again: it writes the file anew from its ledger"
        ) from error
