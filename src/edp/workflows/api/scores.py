"""Scores of a predictor and its baselines, and results of a model search, as tables, data frames and figures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from edp.evaluation.study import StudyFile, read_study
from edp.report import Facts, headline
from edp.report.notebook import html_of, score_figure, score_tables, study_figure, study_html, text_of
from edp.report.run.facts import METRICS, comparison_rows, score
from edp.report.search import words
from edp.table import Table
from edp.workflows.api.frames import OneFrame


class ShownTable:
    """Tables that print as text and show as HTML.

    Args:
        tables: one below the other.
    """

    def __init__(self, tables: list[Table]) -> None:
        self._tables = tables

    def __repr__(self) -> str:
        """Return the tables as text."""
        return "\n\n".join(map(text_of, self._tables))

    def _repr_html_(self) -> str:
        """Return an HTML table for a notebook."""
        return html_of(self._tables)


class JudgedScores(OneFrame):
    """Scores of a predictor and of its baselines on the same ticks, in the units of reports (mm/s, bar, ...).

    A frame has a row for each model and horizon.

    Args:
        facts: description of the evaluated data.
    """

    def __init__(self, facts: Facts) -> None:
        self._facts = facts

    @property
    def folder(self) -> Path:
        """Folder that holds ``scores.json``, or the evaluated bundle."""
        return self._facts.folder

    def to_dict(self) -> Mapping[str, object]:
        """Return everything that was measured: the content of ``scores.json``."""
        return {} if self._facts.scores is None else self._facts.scores.to_table()

    def table(self) -> ShownTable:
        """Return one table per horizon with every evaluated model, the best first."""
        return ShownTable(score_tables(self._facts))

    def plot(self) -> Any:
        """Plot the RMSE of every evaluated model, over the horizon if there are several (Plotly)."""
        return score_figure(self._facts)

    def _columns(self) -> dict[str, list[Any]]:
        rows = [(k, row) for k in sorted(self._facts.horizons) for row in comparison_rows(self._facts, k)]
        columns: dict[str, list[Any]] = {"horizon": [k for k, _ in rows]}
        columns |= {key: [getattr(row, key) for _, row in rows] for key in ("model", *METRICS, "change", "seconds")}
        for target in self._facts.targets:
            for metric in ("mae", "rmse"):
                columns[f"{metric} {target.name}"] = [
                    score(self._facts.models[row.model], k, metric, target.name) for k, row in rows
                ]
        return columns

    def __repr__(self) -> str:
        """Return the headline and the tables as text."""
        return f"{headline(self._facts)}\n\n{self.table()!r}"

    def _repr_html_(self) -> str:
        """Return the headline and the tables as HTML for a notebook."""
        return html_of(score_tables(self._facts), headline(self._facts))


class SearchStudy:
    """State and results of a model search.

    Args:
        facts: results of the study.
    """

    def __init__(self, facts: StudyFile) -> None:
        self._facts = facts

    @property
    def state(self) -> str:
        """``running``, ``stopped``, ``killed`` or ``finished``."""
        return self._facts.state

    def plot(self, name: str | None = None) -> Any:
        """Plot a part of the study: ``variance``, ``pareto``, ``confirmation``, ``screening`` or ``history`` (Plotly).

        Args:
            name: name of the part; by default the first part that has results.

        Raises:
            ConfigError: no such figure, or nothing is decided yet.
        """
        return study_figure(self._facts, name)

    def __repr__(self) -> str:
        """Return the headline and the conclusions as text."""
        return " ".join([words.headline(self._facts), *words.verdict(self._facts)])

    def _repr_html_(self) -> str:
        """Return the conclusions and the phases as HTML for a notebook."""
        return study_html(self._facts)


def load_study(path: str | Path) -> SearchStudy:
    """Load a model search from the folder of ``edp search --out``, finished or not.

    Raises:
        StorageError: no study, or one of another version.
    """
    return SearchStudy(read_study(path))
