"""One offline HTML page of what a data set covers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edp.data.coverage import INTEGRATED, Coverage
from edp.data.coverage_targets import BEYOND, OCCUPANCY, wanted
from edp.data.spectrum import FLAT_DB
from edp.logs import DataQuality
from edp.report.common.tables import TextTable
from edp.report.common.templates import template
from edp.report.common.wording import MISSING, listed, number, percent, unbroken, whole
from edp.report.coverage.plots import coverage_plots
from edp.report.coverage.quality import quality_tables
from edp.report.run.page import shown
from edp.storage import write_bytes


def build_coverage_page(found: Coverage, output: str | Path, title: str, quality: DataQuality | None = None) -> Path:
    """Write what a data set covers as one HTML file that opens with no network.

    Args:
        found: what it covers.
        output: where to write.
        title: name of the data set.
        quality: how good its recordings are.

    Raises:
        StorageError: the page cannot be written.
    """
    target = Path(output)
    write_bytes(target, render_coverage(found, title, quality).encode("utf-8", "replace"))
    return target


def render_coverage(found: Coverage, title: str, quality: DataQuality | None = None) -> str:
    """The page's text."""
    plots = coverage_plots(found)
    context: dict[str, Any] = {
        "title": title,
        "size": f"{found.recordings} recording{'s' * (found.recordings != 1)}, {number(found.hours, 2)} h at "
        f"{found.rate_hz:g} Hz",
        "headline": unbroken(headline(found)),
        "verdict": verdict(found),
        "tiles": tiles(found),
        **shown(plots),
        "wanted": wanted_table(found),
        "found": found,
        "quality": {} if quality is None else quality_tables(quality),
        "integrated": found.occupancy is not None and found.occupancy.source == INTEGRATED,
        "activity": activity_table(found),
        "together": together_table(found),
        "events": events_table(found),
        "joints": joints_table(found),
        "distance": distance_table(found),
    }
    return template("coverage.html.jinja").render(**context)


def headline(found: Coverage) -> str:
    """What the data cover, in a sentence."""
    parts = []
    if found.occupancy is not None:
        kind = "of the poses" if found.occupancy.samples.ndim > 1 else "of the stroke"
        parts.append(f"visits {percent(found.occupancy.share)} {kind}")
    if found.spectrum is not None and any(found.spectrum.flat_to_hz):
        parts.append(f"excites its commands up to {number(min(found.spectrum.flat_to_hz), 1)} Hz")
    if found.distance is not None and found.distance.beyond > BEYOND:
        parts.append(f"leaves {percent(found.distance.beyond)} of the tests far from training")
    size = f"{number(found.hours, 1 if found.hours >= 1 else 2)} h of data"
    return f"{size} that {listed(parts)}." if parts else f"{size}."


def verdict(found: Coverage) -> list[str]:
    """What is missing for learning a model of the machine from these data."""
    lines = []
    inputs = found.spectrum
    if inputs is not None and any(inputs.flat_to_hz) and min(inputs.flat_to_hz) < inputs.used_hz:
        lines.append(
            f"Commands fall by {FLAT_DB:g} dB before {inputs.used_hz:.2g} Hz, where they lie up to "
            f"{number(max(inputs.drop_db), 0)} dB below their maximum: faster changes teach little here."
        )
    if found.occupancy is not None and found.occupancy.share < OCCUPANCY:
        lines.append(f"Fewer than {percent(OCCUPANCY)} of the cells were visited; the white ones were never.")
    if found.constant:
        lines.append(f"{listed(found.constant)} never change{'s' * (len(found.constant) == 1)}.")
    return lines


def tiles(found: Coverage) -> list[tuple[str, str, str]]:
    """Key figures: value, unit, what."""
    made: list[tuple[str, str, str]] = []
    if found.occupancy is not None:
        cells = found.occupancy.samples.size
        made.append((number(100 * found.occupancy.share, 0), "%", f"of {cells} cells of the strokes visited"))
    if found.spectrum is not None and found.spectrum.flat_to_hz:
        made.append(
            (number(min(found.spectrum.flat_to_hz), 2), "Hz", f"every command within {FLAT_DB:g} dB up to here")
        )
    if found.singular:
        lags = max(found.singular)
        made.append((f"{found.singular[lags]:.2g}", "", f"smallest singular value of the inputs, {lags} lags"))
    turns = [axis.reversals for axis in found.activity if axis.reversals is not None]
    if turns:
        made.append((whole(sum(turns)), "", "reversals of the commands"))
    if found.distance is not None:
        made.append(
            (percent(found.distance.beyond).rstrip(" %"), "%", "of the tests farther than 95 % of the training")
        )
    return made


def wanted_table(found: Coverage) -> TextTable | None:
    """Figures beside what is wanted of them."""
    rows = tuple(
        (
            _first_up(w.name),
            f"{number(w.value, 2)} {w.unit}",
            f"{'at least' if w.at_least else 'at most'} {w.bound:g} {w.unit}",
            "met" if w.met else "not met",
        )
        for w in wanted(found)
    )
    columns = (("Figure", ""), ("Here", ""), ("Wanted", ""), ("Verdict", ""))
    return TextTable("Wanted of data to learn a machine from", columns, rows) if rows else None


def activity_table(found: Coverage) -> TextTable | None:
    """Commands by axis."""
    rows = tuple(
        (axis.axis, whole(axis.reversals), whole(axis.crossings), percent(axis.active))
        for axis in found.activity
        if axis.reversals is not None
    )
    columns = (("Axis", ""), ("Reversals", ""), ("Left the dead band", "times"), ("Commanded", "of the time"))
    return TextTable("Commands", columns, rows) if rows else None


def together_table(found: Coverage) -> TextTable | None:
    """Axes in use at once."""
    rows = tuple((_first_up(name), percent(share)) for name, share in found.together.items())
    return TextTable("In use at once", (("Commanded", ""), ("Share", "of the time")), rows) if rows else None


def events_table(found: Coverage) -> TextTable:
    """Events, recorded or not."""
    rows = tuple(
        (_first_up(event.name), whole(event.count), percent(event.share), event.note or "recorded")
        for event in found.events
    )
    return TextTable("How often", (("Event", ""), ("Count", ""), ("Share", "of the time"), ("Source", "")), rows)


def joints_table(found: Coverage) -> TextTable | None:
    """Joint histograms in figures."""
    rows = tuple(
        (f"{j.x} and {j.y}", percent(j.filled), number(j.correlation, 2), number(j.information, 2))
        for j in found.joints
    )
    columns = (("Signals", ""), ("Bins filled", ""), ("Correlation", ""), ("Mutual information", "nat"))
    return TextTable("Joint histograms in figures", columns, rows) if rows else None


def distance_table(found: Coverage) -> TextTable | None:
    """Distance from tests to training beside that within training."""
    far = found.distance
    if far is None:
        return None
    rows = (
        ("From test to training", number(far.test[0], 2), number(far.test[1], 2), percent(far.beyond)),
        ("Within training", number(far.train[0], 2), number(far.train[1], 2), percent(0.05)),
    )
    columns = (("Nearest neighbour", ""), ("Median", ""), ("95 % quantile", ""), ("Beyond 95 % of training", ""))
    return TextTable(f"Distance in deviations of {far.signals} signals", columns, rows)


def _first_up(text: str) -> str:
    return text[:1].upper() + text[1:] if text else MISSING
