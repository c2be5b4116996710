"""Experiments in one MAT file, each of which becomes a recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from edp.errors import DataError
from edp.logs.proposal.columns import look_at_log
from edp.logs.proposal.groups import LogGroup, fits, some_of

TRAINING_WORDS = ("est", "train", "id", "training", "identification")
TEST_WORDS = ("val", "test", "validation")
"""Words in variable names that mark a test or validation experiment."""
MAX_EXPERIMENTS = 2000
"""Maximum number of experiments in a group of files. Each becomes a recording in the data-set file."""


@dataclass(frozen=True)
class Experiments:
    """Experiments with the same columns.

    Attributes:
        group: examined experiments, as logs.
        entries: file and name of each.
        others: experiments with other columns, by file and name.
    """

    group: LogGroup
    entries: tuple[tuple[Path, str], ...]
    others: tuple[str, ...]

    def names(self) -> list[str]:
        """Return unique names of the recordings: ``train_1``, after the file name if there are several files."""
        files = {path for path, _ in self.entries}
        short = [entry.replace("{", "_").rstrip("}") for _, entry in self.entries]
        return short if len(files) == 1 else [f"{path.stem}_{name}" for (path, _), name in zip(self.entries, short)]

    def tests(self) -> list[str]:
        """Return the recordings that the author named as test data; empty if the names do not indicate test data."""
        variables = [entry.partition("{")[0].lower() for _, entry in self.entries]
        parted = {word in TRAINING_WORDS for word in variables} == {True, False}
        named = set(variables) <= {*TRAINING_WORDS, *TEST_WORDS}
        if not (parted and named):
            return []
        return [name for name, word in zip(self.names(), variables) if word in TEST_WORDS]


def part_experiments(group: LogGroup) -> Experiments | None:
    """Return the experiments in the logs of a group; None without experiments.

    Raises:
        DataError: too many for a data set.
    """
    entries = [(look.path, name) for look in group.looks for name in look.experiments]
    if not entries:
        return None
    if len(entries) > MAX_EXPERIMENTS:
        raise DataError(
            f"'{group.looks[0].path}' and its like hold {len(entries):,} experiments; at most {MAX_EXPERIMENTS:,} "
            "become recordings: give fewer files"
        )
    looks = [replace(look_at_log(path, name), path=_pseudo_path(path, name)) for path, name in some_of(entries)]
    alike = [look for look in looks if fits(looks[0], frozenset(look.names))]
    others = {look.path for look in looks if look not in alike}
    alike_entries = tuple(entry for entry in entries if _pseudo_path(*entry) not in others)
    ordered = tuple(sorted(alike, key=lambda look: -look.rows))
    group = LogGroup(ordered, tuple(_pseudo_path(*entry) for entry in alike_entries))
    return Experiments(group, alike_entries, tuple(path.name for path in others))


def _pseudo_path(path: Path, name: str) -> Path:
    """Return a path that identifies an experiment; no file has this path."""
    return path.with_name(f"{path.name} {name.replace('/', '_')}")
