"""The limit of predictability of the data that a run learned from, as a line of its report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edp.errors import StorageError
from edp.storage import read_json
from edp.storage.paths import is_file_at, is_folder_at
from edp.wording import interval, interval_decimals, number

if TYPE_CHECKING:
    from edp.report.run.facts import Facts

FILE = "limit.json"
KINDS = ("commands_unknown", "commands_known", "persistence")


def read_limit(path: Path | None, provenance: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """The limit in a file, or in the folder that the run's data came from; None where there is none.

    Raises:
        StorageError: the file that was named is missing, or a limit is damaged.
    """
    if path is None:
        data = (provenance or {}).get("data", {})
        source = Path(str((data.get("reader") or {}).get("path") or data.get("source") or ""))
        path = source / FILE
        if not is_folder_at(source) or not is_file_at(path):
            return None
    elif is_folder_at(path):
        path = path / FILE
    limit = read_json(path)
    complete = isinstance(limit, dict) and {"unit", "rate_hz", "horizons", "targets", *KINDS} <= limit.keys()
    if not complete:
        raise StorageError(f"'{path}' holds no limit of predictability; `edp simulate FOLDER --limit` writes one")
    return dict(limit)


def limit_line(facts: Facts, samples: int | None) -> str:
    """The limit at `samples` ahead in a sentence; empty where it is of other signals, or not known there."""
    limit = facts.limit
    if limit is None or samples is None or facts.rate_hz != limit["rate_hz"] or samples not in limit["horizons"]:
        return ""
    if [target.name for target in facts.targets] != list(limit["targets"]) or facts.unit != limit["unit"]:
        return ""
    row = list(limit["horizons"]).index(samples)
    unknown = limit["commands_unknown"]
    least, low, high = (unknown[key][row][-1] for key in ("mae", "low", "high"))
    least_error = number(least, interval_decimals(low, high))
    error_with_commands = number(limit["commands_known"]["mae"][row][-1], 2)
    return (
        f"The limit of predictability here is {least_error} {facts.unit} (95 %: {interval(low, high)}): even a "
        "predictor that "
        f"knows the true state has that mean absolute error, for it knows neither the operator's next choices nor the "
        f"noise to come; with the commands known, its error would be {error_with_commands}."
    )
