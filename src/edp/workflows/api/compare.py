"""Comparison of several runs from Python."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edp.report.compare.page import build_compare_page, error_table
from edp.report.compare.paired import Comparison, compare_runs
from edp.report.notebook import html_of, text_of
from edp.table import Table
from edp.workflows.api.frames import OneFrame


class ComparedRuns(OneFrame):
    """Evaluated runs on their common test recordings; the first run is the reference for the others.

    A frame has a row for each run and error.

    Args:
        comparison: comparison of the runs.
    """

    def __init__(self, comparison: Comparison) -> None:
        self._comparison = comparison

    @property
    def recordings(self) -> tuple[str, ...]:
        """Test recordings on which all runs were evaluated."""
        return self._comparison.recordings

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks for the reader: omitted recordings, different data, different settings."""
        return self._comparison.remarks

    def report(self, target: str | Path, title: str = "") -> Path:
        """Write the page.

        Raises:
            StorageError: it cannot be written.
        """
        return build_compare_page(self._comparison, title).write(target)

    def _columns(self) -> dict[str, list[Any]]:
        of = self._comparison
        columns: dict[str, list[Any]] = {key: [] for key in ("run", "output", "ahead_s", "error", "unit")}
        columns |= {key: [] for key in ("change", "low", "high", "p")}
        for measure in of.measures:
            differences = of.differences(measure)
            for run in of.runs:
                values = (run.name, measure.output, measure.ahead_s, of.error(run, measure), measure.unit)
                other = differences.get(run.name)
                ends = (None,) * 4 if other is None else (other.change, other.low, other.high, other.p)
                for key, value in zip(columns, (*values, *ends), strict=True):
                    columns[key].append(value)
        return columns

    def _tables(self) -> list[Table]:
        return [error_table(self._comparison, measure) for measure in self._comparison.measures]

    def __repr__(self) -> str:
        """Return the headline and the tables as text."""
        return "\n\n".join([self._comparison.headline(), *self.remarks, *map(text_of, self._tables())])

    def _repr_html_(self) -> str:
        """Return the headline and the tables as HTML for a notebook."""
        return html_of(self._tables(), self._comparison.headline())


def compare(*runs: str | Path) -> ComparedRuns:
    """Compare evaluated runs on their common test recordings, with paired confidence intervals.

    Args:
        runs: 2 to 12 run folders; the others are measured against the first.

    Raises:
        ConfigError: too few, too many, or one twice.
        StorageError: a folder holds no evaluated run, or something damaged.
        DataError: twins beside networks, nothing in common, or recordings of one name that differ.
    """
    return ComparedRuns(compare_runs(runs))
