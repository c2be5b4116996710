"""One offline HTML page of what a data set covers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edp.data.coverage import INTEGRATED, Coverage
from edp.data.coverage_targets import BEYOND, OCCUPANCY, wanted
from edp.data.spectrum import FLAT_DB
from edp.errors import count_of
from edp.logs import DataQuality
from edp.report.common.templates import template
from edp.report.coverage.charts import coverage_charts
from edp.report.coverage.quality import quality_tables
from edp.report.run.page import shown
from edp.storage import write_bytes
from edp.table import Column, Table
from edp.wording import MISSING, count_text, figure, listed, number, percent, unbroken


def build_coverage_page(coverage: Coverage, output: str | Path, title: str, quality: DataQuality | None = None) -> Path:
    """Write what a data set covers as one HTML file that opens with no network.

    Args:
        coverage: what it covers.
        output: where to write.
        title: name of the data set.
        quality: how good its recordings are.

    Raises:
        StorageError: the page cannot be written.
    """
    target = Path(output)
    write_bytes(target, render_coverage(coverage, title, quality).encode("utf-8", "replace"))
    return target


def render_coverage(coverage: Coverage, title: str, quality: DataQuality | None = None) -> str:
    """The page's text."""
    charts = coverage_charts(coverage)
    context: dict[str, Any] = {
        "title": title,
        "size": f"{count_of(coverage.recordings, 'recording')}, {number(coverage.hours, 2)} h at "
        f"{figure(coverage.rate_hz)} Hz",
        "headline": unbroken(headline(coverage)),
        "verdict": verdict(coverage),
        "tiles": tiles(coverage),
        **shown(charts),
        "wanted": wanted_table(coverage),
        "found": coverage,
        "quality": {} if quality is None else quality_tables(quality),
        "integrated": coverage.occupancy is not None and coverage.occupancy.source == INTEGRATED,
        "activity": activity_table(coverage),
        "together": together_table(coverage),
        "events": events_table(coverage),
        "joints": joints_table(coverage),
        "distance": distance_table(coverage),
    }
    return template("coverage.html.jinja").render(**context)


def headline(coverage: Coverage) -> str:
    """What the data cover, in a sentence."""
    parts = []
    if coverage.occupancy is not None:
        kind = "of the poses" if coverage.occupancy.samples.ndim > 1 else "of the stroke"
        parts.append(f"visits {percent(coverage.occupancy.share)} {kind}")
    if coverage.spectrum is not None and any(coverage.spectrum.flat_to_hz):
        parts.append(f"excites its commands up to {number(min(coverage.spectrum.flat_to_hz), 1)} Hz")
    if coverage.distance is not None and coverage.distance.beyond > BEYOND:
        parts.append(f"leaves {percent(coverage.distance.beyond)} of the tests far from training")
    size = f"{number(coverage.hours, 1 if coverage.hours >= 1 else 2)} h of data"
    return f"{size} that {listed(parts)}." if parts else f"{size}."


def verdict(coverage: Coverage) -> list[str]:
    """What is missing for learning a model of the machine from these data."""
    lines = []
    inputs = coverage.spectrum
    if inputs is not None and any(inputs.flat_to_hz) and min(inputs.flat_to_hz) < inputs.used_hz:
        lines.append(
            f"Commands fall by {figure(FLAT_DB)} dB before {inputs.used_hz:.2g} Hz, where they lie up to "
            f"{number(max(inputs.drop_db), 0)} dB below their maximum: faster changes teach little here."
        )
    if coverage.occupancy is not None and coverage.occupancy.share < OCCUPANCY:
        lines.append(f"Fewer than {percent(OCCUPANCY)} of the cells were visited; the empty ones were never.")
    if coverage.constant:
        lines.append(f"{listed(coverage.constant)} never change{'s' * (len(coverage.constant) == 1)}.")
    return lines


def tiles(coverage: Coverage) -> list[tuple[str, str, str]]:
    """Key figures: value, unit, what."""
    tiles: list[tuple[str, str, str]] = []
    if coverage.occupancy is not None:
        cells = coverage.occupancy.samples.size
        tiles.append((number(100 * coverage.occupancy.share, 0), "%", f"of {cells} cells of the strokes visited"))
    if coverage.spectrum is not None and coverage.spectrum.flat_to_hz:
        tiles.append(
            (
                number(min(coverage.spectrum.flat_to_hz), 2),
                "Hz",
                f"commands within {figure(FLAT_DB)} dB up to here",
            )
        )
    if coverage.singular:
        lags = max(coverage.singular)
        tiles.append((f"{coverage.singular[lags]:.2g}", "", f"smallest singular value of the inputs, {lags} lags"))
    turns = [axis.reversals for axis in coverage.activity if axis.reversals is not None]
    if turns:
        tiles.append((count_text(sum(turns)), "", "reversals of the commands"))
    if coverage.distance is not None:
        tiles.append(
            (percent(coverage.distance.beyond).rstrip(" %"), "%", "of the tests farther than 95 % of the training")
        )
    return tiles


def wanted_table(coverage: Coverage) -> Table | None:
    """Figures beside what is wanted of them."""
    rows = tuple(
        (
            _first_up(w.name),
            f"{number(w.value, 2)} {w.unit}",
            f"{'at least' if w.at_least else 'at most'} {figure(w.bound)} {w.unit}",
            "met" if w.met else "not met",
        )
        for w in wanted(coverage)
    )
    columns = (Column("Figure"), Column("Here"), Column("Wanted"), Column("Verdict"))
    return Table("Wanted of data to learn a machine from", columns, rows) if rows else None


def activity_table(coverage: Coverage) -> Table | None:
    """Commands by axis."""
    rows = tuple(
        (axis.axis, count_text(axis.reversals), count_text(axis.crossings), percent(axis.active))
        for axis in coverage.activity
        if axis.reversals is not None
    )
    columns = (
        Column("Axis"),
        Column("Reversals"),
        Column("Left the dead band", "times"),
        Column("Commanded", "of the time"),
    )
    return Table("Commands", columns, rows) if rows else None


def together_table(coverage: Coverage) -> Table | None:
    """Axes in use at once."""
    rows = tuple((_first_up(name), percent(share)) for name, share in coverage.together.items())
    return Table("In use at once", (Column("Commanded"), Column("Share", "of the time")), rows) if rows else None


def events_table(coverage: Coverage) -> Table | None:
    """Return the events in the recordings; None if the channels cannot show events."""
    rows = tuple(
        (_first_up(event.name), count_text(event.count), percent(event.share), event.note or "recorded")
        for event in coverage.events
        if event.count is not None
    )
    columns = (Column("Event"), Column("Count"), Column("Share", "of the time"), Column("Source"))
    return Table("How often", columns, rows) if rows else None


def joints_table(coverage: Coverage) -> Table | None:
    """Joint histograms in figures."""
    rows = tuple(
        (f"{j.x} and {j.y}", percent(j.filled), number(j.correlation, 2), number(j.information, 2))
        for j in coverage.joints
    )
    columns = (Column("Signals"), Column("Bins filled"), Column("Correlation"), Column("Mutual information", "nat"))
    return Table("Joint histograms in figures", columns, rows) if rows else None


def distance_table(coverage: Coverage) -> Table | None:
    """Distance from tests to training beside that within training."""
    far = coverage.distance
    if far is None:
        return None
    rows = (
        ("From test to training", number(far.test[0], 2), number(far.test[1], 2), percent(far.beyond)),
        ("Within training", number(far.train[0], 2), number(far.train[1], 2), percent(0.05)),
    )
    columns = (
        Column("Nearest neighbour"),
        Column("Median"),
        Column("95 % quantile"),
        Column("Beyond 95 % of training"),
    )
    return Table(f"Distance in deviations of {far.signals} signals", columns, rows)


def _first_up(text: str) -> str:
    return text[:1].upper() + text[1:] if text else MISSING
