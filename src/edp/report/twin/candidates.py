"""The formulations that a twin was chosen among, as the file of its run has them: rows, a table, and a sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from edp.evaluation.scores_file import COUNT, NUMBER, REAL, KeyedObject, Leaf, Listed, read_shaped
from edp.storage.paths import is_file_at
from edp.table import Column, Table, Value, figures

CANDIDATES = "candidates.json"
MOST_CANDIDATES = 100
"""Rows that are read; a choice leaves a dozen."""
MOST_TEXT = 2_000
"""Characters of a label or reason: EDP's own messages are shorter."""
TEXT = Leaf(
    lambda value: isinstance(value, str) and len(value) <= MOST_TEXT, f"a text of at most {MOST_TEXT:,} characters"
)
TRUTH = Leaf(lambda value: isinstance(value, bool), "true or false")
ROW = KeyedObject(
    {"label": TEXT, "error": NUMBER, "seconds": REAL, "chosen": TRUTH, "why": TEXT},
    ("label", "error", "seconds", "chosen", "why"),
)
SHAPE = KeyedObject({"schema": COUNT, "candidates": Listed(ROW)}, ("schema", "candidates"))


def read_candidates(folder: str | Path) -> list[dict[str, Any]]:
    """Rows of the candidates of a run, the simplest first; none where its settings name the formulation.

    Raises:
        StorageError: the file is damaged.
    """
    path = Path(folder) / CANDIDATES
    rows: list[dict[str, Any]] = read_shaped(path, SHAPE)["candidates"] if is_file_at(path) else []
    return rows[:MOST_CANDIDATES]


def choice_sentence(rows: Sequence[Mapping[str, Any]]) -> str:
    """What was chosen and why."""
    chosen = next((row for row in rows if row["chosen"]), None)
    if chosen is None or chosen["error"] is None:
        return ""
    others = [row for row in rows if row is not chosen and row["error"] is not None]
    share = f"{chosen['error']:.2f} of the static map's error"
    text = f"{chosen['label']}: on free runs that its fits had not seen it has {share}"
    if not others:
        return f"{text}."
    least = min(others, key=lambda row: float(row["error"]))
    beside = "is hardly better for more" if least["error"] < chosen["error"] else "comes next"
    return f"{text}; {least['label']} {beside} ({least['error']:.2f})."


def candidate_sheet(rows: Sequence[Mapping[str, Any]]) -> Table:
    """The candidates as a table, the chosen one marked."""
    lines: list[tuple[Value, ...]] = [(row["label"], row["error"], row["seconds"], row["why"]) for row in rows]
    marked = frozenset(i for i, row in enumerate(rows) if row["chosen"])
    heads: tuple[Column, ...] = (
        Column("Formulation"),
        Column("Error", "of the static map's", figures((row["error"] for row in rows), decimals=3)),
        Column("Processor time", "s", figures((row["seconds"] for row in rows), decimals=0)),
        Column("Left out because"),
    )
    heads = heads if any(row["why"] for row in rows) else heads[:3]
    lines = [line[: len(heads)] for line in lines]
    caption = (
        "Candidates on free runs that their fits had not seen: the simplest one that is as good as the best is kept"
    )
    return Table(caption, heads, tuple(lines), marked, name="candidates")
