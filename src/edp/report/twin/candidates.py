"""The formulations that a twin was chosen among, as the file of its run has them: rows, a table, and a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from edp.evaluation.free_run_file import CandidateRow, CandidatesFile
from edp.storage.paths import is_file_at
from edp.table import Column, Table, Value, figures

MAX_CANDIDATES = 100
"""Maximum number of rows read. A selection has about a dozen candidates."""


def read_candidates(folder: str | Path) -> tuple[CandidateRow, ...]:
    """Return the candidates of a run, the simplest first; empty if the settings name the formulation.

    Raises:
        StorageError: the file is damaged.
    """
    if not is_file_at(Path(folder) / CandidatesFile.NAME):
        return ()
    return CandidatesFile.read(folder).candidates[:MAX_CANDIDATES]


def choice_sentence(rows: Sequence[CandidateRow]) -> str:
    """State the chosen formulation and the reason."""
    chosen = next((row for row in rows if row.chosen), None)
    if chosen is None or chosen.error is None:
        return ""
    others = [(row.error, row.label) for row in rows if row is not chosen and row.error is not None]
    share = f"{chosen.error:.2f} of the static map's error"
    text = f"{chosen.label}: on free runs that its fits had not seen it has {share}"
    if not others:
        return f"{text}."
    error, label = min(others, key=lambda pair: pair[0])
    rank = "is hardly better for more" if error < chosen.error else "comes next"
    return f"{text}; {label} {rank} ({error:.2f})."


def candidate_table(rows: Sequence[CandidateRow]) -> Table:
    """Return the candidates as a table with the chosen one marked."""
    lines: list[tuple[Value, ...]] = [(row.label, row.error, row.seconds, row.why) for row in rows]
    marked = frozenset(i for i, row in enumerate(rows) if row.chosen)
    heads: tuple[Column, ...] = (
        Column("Formulation"),
        Column("Error", "of the static map's", figures((row.error for row in rows), decimals=3)),
        Column("Processor time", "s", figures((row.seconds for row in rows), decimals=0)),
        Column("Left out because"),
    )
    heads = heads if any(row.why for row in rows) else heads[:3]
    lines = [line[: len(heads)] for line in lines]
    caption = (
        "Candidates on free runs that their fits had not seen: the simplest one that is as good as the best is kept"
    )
    return Table(caption, heads, tuple(lines), marked, name="candidates")
