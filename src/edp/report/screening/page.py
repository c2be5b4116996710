"""One offline HTML page of a screening: which channels to feed a model, and why."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from markupsafe import Markup

from edp.errors import count_of
from edp.logs import DataQuality
from edp.report.common.page import Fold, Page, Paragraph, Section, Subsection, Terms
from edp.report.common.picture import write_pictures
from edp.report.coverage.quality import quality_section
from edp.report.screening import tables
from edp.report.screening.charts import screening_charts
from edp.report.screening.views import best_groups, joined
from edp.wording import count_text, duration, figure, listed, number, setting_text

if TYPE_CHECKING:
    from edp.data.screening import ScreeningResult
    from edp.evaluation.trials_file import Trials

FLAGS_TEXT = Markup(
    "A negative lag means that the channel shows the value that the other will have that many samples later; a leak of "
    "the future is never available when a model runs. A command, or a faster sensor of the same, can resemble one "
    "where the machine follows it exactly: name it as trusted (<code>--trusted</code>) if it is measured."
)


def build_screening_page(
    screening: ScreeningResult,
    title: str,
    quality: DataQuality | None = None,
    trials: Trials | None = None,
    notes: Sequence[str] = (),
) -> Page:
    """Return the page of a screening.

    Args:
        screening: the screening.
        title: name of the data set.
        quality: quality of its recordings.
        trials: errors of a network on several feature sets.
        notes: remarks on how the data were read.
    """
    charts = {chart.name: chart for chart in screening_charts(screening)}
    hours = screening.samples / screening.rate_hz / 3600
    ahead = f"{screening.horizon} samples ({figure(1e3 * screening.horizon / screening.rate_hz)} ms)"
    dropped = tables.tabulate_dropped(screening)
    left_out = f"{count_of(len(dropped.rows), 'channel')} to leave out, and why"
    options = sorted((key.replace("_", " "), setting_text(value)) for key, value in screening.options.items())
    return Page(
        title=title,
        kind="screening",
        about=[
            "screening",
            f"{count_of(len(screening.recordings), 'recording')}, {number(hours, 2)} h at "
            f"{figure(screening.rate_hz)} Hz",
        ],
        headline=headline(screening),
        verdict=verdict(screening, quality),
        tiles=tiles(screening),
        sections=[
            Section(
                "proposal",
                "Proposal",
                [
                    f"For predicting {', '.join(screening.targets)}, {ahead} ahead. "
                    f"{sentence(screening.proposal.window_reason)} A lag in brackets is not certain.",
                    tables.tabulate_kept(screening),
                    Fold(left_out, [dropped], is_printed=False),
                    *(Paragraph(note, "quiet") for note in notes),
                ],
            ),
            *([] if trials is None else [_trials_section(trials)]),
            Section(
                "flags",
                "Channels that something is wrong with",
                [Paragraph(FLAGS_TEXT), tables.flags_table(screening)],
                "Flags",
            ),
            Section(
                "matrices",
                "Dependence at the same instant",
                [
                    "Over all samples of all recordings. Rank correlations see any rising or falling relation, mutual "
                    "information any relation at all; what lies below a few hundredths of a nat is chance. Zoom by "
                    "dragging, double-click to return.",
                    charts.get("matrices"),
                ],
                "Dependence",
            ),
            Section(
                "lags",
                "Lags",
                [
                    "Cross-correlation of channel and target: a maximum at −15 means that the target goes best with "
                    "the channel of 15 samples before. In the legend, the best lag.",
                    charts.get("lags"),
                    tables.ranges_table(screening),
                    Fold("Channel by channel", [tables.lags_table(screening)]),
                ],
            ),
            Section(
                "stability",
                "Stability over the recordings",
                [
                    f"Mean of each metric over {len(screening.pieces)} stretches, with a deviation to both sides; the "
                    "stroke is what unrelated stretches give. A channel whose bar reaches across zero owes its "
                    "relation to some recordings only. Blue is proposed.",
                    charts.get("stability"),
                ],
                "Stability",
            ),
            Section(
                "importance",
                "Importance together with all others",
                [
                    "How much the squared error of a random forest grows on held-out recordings where a group of "
                    "collinear channels is shuffled together, as a share of the target's variance, with its 95 % "
                    "interval.",
                    charts.get("importance"),
                    Subsection(
                        [
                            "Share of the remaining squared error that the channel's past takes away from a linear "
                            "prediction which has the pasts of all other usable channels, on held-out stretches, with "
                            "its 95 % interval.",
                            charts.get("value"),
                        ],
                        "Value of a channel's past",
                    ),
                ],
                "Importance",
            ),
            Section(
                "clusters",
                "Channels that go together",
                [
                    "Complete linkage on the absolute rank correlation: one of a group says nearly all that the group "
                    "says.",
                    tables.clusters_table(screening),
                ],
                "Clusters",
            ),
            *([] if quality is None else [quality_section(quality)]),
            Section(
                "how",
                "How it was done",
                [
                    f"{count_of(screening.samples, 'sample')} of {count_of(len(screening.channels), 'channel')} in "
                    f"{duration(sum(screening.seconds.values()))}.",
                    tables.stages_table(screening),
                    Fold("Options", [Terms(options)]),
                ],
                "How",
            ),
        ],
        footer="Pictures of it lie beside it as SVG and PNG.",
    )


def _trials_section(trials: Trials) -> Section:
    return Section(
        "trials",
        "Held-out errors of the sets",
        [
            "The same network with the same budget, trained on each set and judged on recordings that neither it nor "
            f"its early stopping saw ({', '.join(trials.held_out)}).",
            tables.trials_table(trials),
            *(Paragraph(f"{note}.", "quiet") for note in trials.notes),
        ],
        "Proof",
    )


def write_screening_pictures(screening: ScreeningResult, folder: str | Path) -> list[Path]:
    """Write every picture as SVG and PNG: matrices, lag curves by target, stability, importance, linear value.

    Args:
        screening: the screening.
        folder: output folder, which is created.

    Returns:
        the files, in order.

    Raises:
        StorageError: the folder or a file cannot be written.
    """
    return write_pictures(folder, screening_charts(screening))


def headline(screening: ScreeningResult) -> str:
    """State the proposal in one sentence."""
    proposed, window = len(screening.proposal.kept), screening.proposal.window
    return (
        f"{proposed} of {count_of(len(screening.channels), 'channel')} are proposed to predict "
        f"{listed(screening.targets)}, with a "
        f"memory of {window} samples ({figure(1e3 * window / screening.rate_hz)} ms)."
    )


def verdict(screening: ScreeningResult, quality: DataQuality | None) -> list[str]:
    """Return the warnings to read before the proposal is used."""
    # Late: the screening brings a compiler, and every command that may write a page imports this module.
    from edp.data.screening import FlagKind

    lines = []
    leaks = sorted({flag.channel for flag in screening.flags if flag.kind is FlagKind.LEAK})
    if leaks:
        shown = listed(leaks[:6]) if len(leaks) <= 6 else f"{', '.join(leaks[:6])} and {len(leaks) - 6} more"
        lines.append(f"{shown} know{'s' * (len(leaks) == 1)} the future and must not be fed to a model.")
    groups = [joined(entry.members) for entry in best_groups(screening) if entry.low > 0]
    if groups:
        lines.append(f"The forest misses {listed(groups)} most.")
    if quality is not None and quality.repeats:
        lines.append("Some recordings repeat each other: read the section on quality before splitting.")
    if quality is not None and quality.errors:
        lines.append("Some recordings hold errors that were repaired for the screening.")
    return [*lines, *(sentence(note) for note in screening.proposal.notes)]


def sentence(text: str) -> str:
    """Return text with a capital at the start and a full stop at the end."""
    stripped = text.strip()
    return stripped and stripped[0].upper() + stripped[1:] + ("" if stripped.endswith((".", "!", "?")) else ".")


def tiles(screening: ScreeningResult) -> list[tuple[str, str, str]]:
    """Return the key figures: value, unit, what."""
    from edp.data.screening import FlagKind  # late: see `verdict`

    tiles = [
        (count_text(len(screening.proposal.kept)), "", f"of {count_of(len(screening.channels), 'channel')} proposed"),
        (count_text(screening.proposal.window), "samples", "suggested memory W"),
    ]
    counts = {kind: len({flag.channel for flag in screening.flags if flag.kind is kind}) for kind in FlagKind}
    words = {
        FlagKind.LEAK: "leaks of the future",
        FlagKind.COPY: "delayed copies",
        FlagKind.ARTEFACT: "artefacts of a file",
        FlagKind.NOISE: "channels without any relation",
    }
    tiles += [(count_text(counts[kind]), "", text) for kind, text in words.items() if counts[kind]]
    return tiles
