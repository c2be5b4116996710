"""Offline HTML page of a data set's coverage."""

from __future__ import annotations

from markupsafe import Markup

from edp.data.coverage import INTEGRATED, Coverage
from edp.data.coverage_targets import BEYOND, OCCUPANCY, wanted
from edp.data.spectrum import FLAT_DB
from edp.errors import count_of
from edp.logs import DataQuality
from edp.report.common.page import Fold, Page, Paragraph, Part, Points, Section, Subsection
from edp.report.coverage.charts import coverage_charts
from edp.report.coverage.quality import quality_section
from edp.table import Column, Table
from edp.wording import MISSING, count_text, figure, listed, number, percent

JOINTS = {
    "joint_command": "Command and motion",
    "joint_head": "Head pressure and motion",
    "joint_rod": "Rod pressure and motion",
    "joint_velocities": "Two axes",
}
"""Heading of each joint histogram, by the name of its figure."""
NO_COMMANDS = Markup(
    "No channel of these recordings is known to command. Name them: <code>edp data check DATA --inputs a,b</code>, or "
    "give a signal map with their kinds."
)


def build_coverage_page(coverage: Coverage, title: str, quality: DataQuality | None = None) -> Page:
    """Return the page of a data set's coverage.

    Args:
        coverage: coverage of the data set.
        title: name of the data set.
        quality: quality of its recordings.
    """
    charts = {chart.name: chart for chart in coverage_charts(coverage)}
    constant = f"Constant, and left out: {', '.join(coverage.constant)}."
    commands: list[Part | None] = [
        Subsection(
            [
                "Power spectral density of each command; what lies far below the shaded band is hardly ever asked for, "
                "so a model cannot learn the answer to it.",
                charts.get("spectrum"),
            ],
            "Spectrum",
        ),
        Subsection(
            [
                "Smallest singular value of the Hankel matrix of the inputs, each brought to deviation 1: the weakest "
                "direction in which the last so many samples of all inputs differ. At zero, models that differ in that "
                "direction cannot be distinguished.",
                charts.get("excitation"),
            ],
            "Persistent excitation",
        ),
        Paragraph(constant, "quiet") if coverage.constant else None,
        activity_table(coverage),
        together_table(coverage),
        None if activity_table(coverage).rows else Paragraph(NO_COMMANDS, "missing"),
    ]
    return Page(
        title=title,
        kind="coverage",
        about=[
            "coverage",
            f"{count_of(coverage.recordings, 'recording')}, {number(coverage.hours, 2)} h at "
            f"{figure(coverage.rate_hz)} Hz",
        ],
        headline=headline(coverage),
        verdict=verdict(coverage),
        tiles=tiles(coverage),
        sections=[
            Section("wanted", "What is wanted", [tabulate_targets(coverage)], "Wanted"),
            Section("commands", "How rich the commands are", commands, "Commands"),
            Section("poses", "Where the machine has been", [_pose_text(coverage), charts.get("occupancy")], "Poses"),
            Section(
                "joint",
                "What was seen together",
                [
                    "Share of the samples in each bin, on a logarithmic scale; a model is at home where there is "
                    "colour. Pearson's correlation and the mutual information at the same instant stand above each "
                    "map.",
                    *(Subsection([charts.get(name)], heading) for name, heading in JOINTS.items()),
                    Fold("The same in figures", [joints_table(coverage)]),
                ],
            ),
            Section(
                "events",
                "Events",
                [
                    "Moments in which another part of the machine decides: a model that met few of them will be "
                    "surprised.",
                    events_table(coverage),
                ],
            ),
            *([] if quality is None else [quality_section(quality)]),
            Section(
                "split",
                "Tests and training",
                [
                    "Distance from each test sample to the nearest training sample, over commands now and 0.2 s "
                    "earlier, velocities and pressures; beside it, as the yardstick, the distance from one half of the "
                    "training recordings to the other.",
                    distance_table(coverage),
                ],
            ),
            Section(
                "contradictions",
                "Contradictions",
                [Points([f"{_first_up(text)}." for text in coverage.contradictions])],
            ),
            Section("absent", "Not examined", [Points([f"{_first_up(text)}." for text in coverage.absent])]),
        ],
    )


def _pose_text(coverage: Coverage) -> str:
    """Return how the maps of strokes are read, and how strokes were found; empty without strokes."""
    occupancy = coverage.occupancy
    if occupancy is None:
        return ""
    text = "cells in a stronger colour were visited longer, empty ones never."
    if occupancy.samples.ndim == 3:
        text = f"One map for each sixth of {occupancy.names[0]}; {text}"
    if occupancy.source == INTEGRATED:
        text += (
            " No stroke is recorded: velocities were integrated, each recording about its own mean, so that offsets "
            "between recordings and drift are in the picture."
        )
    elif not occupancy.full_stroke:
        text += " The full strokes are not known: the maps span the range that was seen."
    return _first_up(text)


def headline(coverage: Coverage) -> str:
    """State the coverage of the data in one sentence."""
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
    """Return the gaps of these data for learning a model of the machine."""
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
    """Return the key figures: value, unit, what."""
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


def tabulate_targets(coverage: Coverage) -> Table:
    """Return figures with their required values."""
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
    return Table("Wanted of data to learn a machine from", columns, rows)


def activity_table(coverage: Coverage) -> Table:
    """Return the commands by axis."""
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
    return Table("Commands", columns, rows)


def together_table(coverage: Coverage) -> Table:
    """Return axes in use at once."""
    rows = tuple((_first_up(name), percent(share)) for name, share in coverage.together.items())
    return Table("In use at once", (Column("Commanded"), Column("Share", "of the time")), rows)


def events_table(coverage: Coverage) -> Table:
    """Return the events in the recordings; None if the channels cannot show events."""
    rows = tuple(
        (_first_up(event.name), count_text(event.count), percent(event.share), event.note or "recorded")
        for event in coverage.events
        if event.count is not None
    )
    columns = (Column("Event"), Column("Count"), Column("Share", "of the time"), Column("Source"))
    return Table("How often", columns, rows)


def joints_table(coverage: Coverage) -> Table:
    """Return the joint histograms in figures."""
    rows = tuple(
        (f"{j.x} and {j.y}", percent(j.filled), number(j.correlation, 2), number(j.information, 2))
        for j in coverage.joints
    )
    columns = (Column("Signals"), Column("Bins filled"), Column("Correlation"), Column("Mutual information", "nat"))
    return Table("Joint histograms in figures", columns, rows)


def distance_table(coverage: Coverage) -> Table | None:
    """Return the distance from tests to training, and that within training."""
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
