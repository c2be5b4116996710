"""Groups of logs in a folder that have nearly the same columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from edp.errors import DataError
from edp.logs.proposal.columns import LogLook, look_at_log, names_in_log
from edp.progress import SILENT, Progress

_One = TypeVar("_One")
MAX_LOGS = 12
"""Maximum number of examined logs per group of files: first, last and some between them."""
_ALIKE = 0.7
"""Minimum fraction of common columns of two logs in one group."""


@dataclass(frozen=True)
class LogGroup:
    """Logs with the same columns, give or take a few.

    Attributes:
        looks: examined logs, the longest first.
        paths: all of them.
        names: columns of those that were not looked at but compared.
    """

    looks: tuple[LogLook, ...]
    paths: tuple[Path, ...]
    names: tuple[frozenset[str], ...] = ()

    @property
    def rows(self) -> int:
        """Number of rows read for the proposal."""
        return sum(look.rows for look in self.looks)

    @property
    def common(self) -> frozenset[str]:
        """Columns that all of them have."""
        return frozenset.intersection(*(frozenset(look.names) for look in self.looks), *self.names)


def group_logs(paths: Sequence[Path], progress: Progress = SILENT) -> tuple[list[LogGroup], dict[Path, str]]:
    """Look at logs and sort them by their columns, the most rows first.

    Args:
        paths: paths of the logs.
        progress: receiver of the progress; its units are logs.

    Returns:
        the groups, and what is wrong with the logs that cannot be read.

    Raises:
        DataError: no log can be read.
    """
    chosen = some_of(paths)
    groups: list[list[LogLook]] = []
    broken: dict[Path, str] = {}
    looking = progress.stage("log", len(chosen))
    for i, path in enumerate(chosen):
        looking.step(i)
        looking.note(path.name)
        try:
            look = look_at_log(path)
        except DataError as error:
            broken[path] = str(error)
            continue
        fitting = next((group for group in groups if _alike(group[0], look)), None)
        if fitting is None:
            groups.append([look])
        else:
            fitting.append(look)
    if not groups:
        first = next(iter(broken.values()))
        raise DataError(first if len(broken) == 1 else f"none of {len(broken)} logs can be read; the first: {first}")
    seen = {look.path for group in groups for look in group} | set(broken)
    members: list[dict[Path, frozenset[str]]] = [{} for _ in groups]
    for path in [path for path in paths if path not in seen]:
        try:
            names = names_in_log(path)
        except DataError as error:
            broken[path] = str(error)
            continue
        fitting_group = next((i for i, group in enumerate(groups) if fits(group[0], names)), None)
        if fitting_group is None:
            broken[path] = f"'{path}' has other columns than the logs that were looked at"
        else:
            members[fitting_group][path] = names
    groups_of_logs = [
        LogGroup(
            tuple(sorted(group, key=lambda look: -look.rows)),
            tuple(path for path in paths if path in {look.path for look in group} or path in others),
            tuple(others.values()),
        )
        for group, others in zip(groups, members)
    ]
    return sorted(groups_of_logs, key=lambda group: -group.rows), broken


def some_of(logs: Sequence[_One]) -> list[_One]:
    """Return at most `MAX_LOGS` evenly spaced logs."""
    places = np.unique(np.linspace(0, len(logs) - 1, min(len(logs), MAX_LOGS)).round().astype(int))
    return [logs[index] for index in places]


def fits(look: LogLook, names: frozenset[str]) -> bool:
    """Return whether a log with the given columns, including time and text, has nearly the columns of `look`."""
    mine = {*look.names, *look.texts} | ({look.time} if look.time is not None else set())
    return len(mine & names) >= _ALIKE * len(mine | names)


def _alike(one: LogLook, other: LogLook) -> bool:
    if one.headerless or other.headerless:
        return one.headerless and other.headerless and one.names == other.names
    mine, theirs = set(one.names), set(other.names)
    return len(mine & theirs) >= _ALIKE * len(mine | theirs)
