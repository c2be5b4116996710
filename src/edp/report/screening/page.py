"""One offline HTML page of a screening: which channels to feed a model, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edp.errors import count_of
from edp.logs import DataQuality
from edp.report.common.picture import write_pictures
from edp.report.common.templates import template
from edp.report.coverage.quality import quality_tables
from edp.report.run.page import shown
from edp.report.screening import tables as tables
from edp.report.screening.charts import screening_charts
from edp.report.screening.views import best_groups, joined
from edp.storage import write_bytes
from edp.wording import count_text, duration, figure, listed, number, setting_text, unbroken

if TYPE_CHECKING:
    from edp.data.screening import ScreeningResult


def build_screening_page(
    screening: ScreeningResult,
    output: str | Path,
    title: str,
    quality: DataQuality | None = None,
    trials: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
) -> Path:
    """Write a screening as one HTML file that opens with no network.

    Args:
        screening: the screening.
        output: where to write.
        title: name of the data set.
        quality: how good its recordings are.
        trials: errors of a network on several feature sets (`edp.workflows.feature_selection.trials.Trials.to_json`).
        notes: what a reader must know of how the data were read.

    Raises:
        StorageError: the page cannot be written.
    """
    target = Path(output)
    write_bytes(target, render_screening(screening, title, quality, trials, notes).encode("utf-8", "replace"))
    return target


def write_screening_pictures(screening: ScreeningResult, folder: str | Path) -> list[Path]:
    """Write every picture as SVG and PNG: matrices, lag curves by target, stability, importance, linear value.

    Args:
        screening: the screening.
        folder: where to write; it is made.

    Returns:
        the files, in order.

    Raises:
        StorageError: the folder or a file cannot be written.
    """
    return write_pictures(folder, screening_charts(screening))


def render_screening(
    screening: ScreeningResult,
    title: str,
    quality: DataQuality | None = None,
    trials: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
) -> str:
    """The page's text."""
    charts = screening_charts(screening)
    hours = screening.samples / screening.rate_hz / 3600
    context: dict[str, Any] = {
        "title": title,
        "size": f"{count_of(len(screening.recordings), 'recording')}, {number(hours, 2)} h "
        f"at {figure(screening.rate_hz)} Hz",
        "headline": unbroken(headline(screening)),
        "verdict": verdict(screening, quality),
        "tiles": tiles(screening),
        **shown(charts),
        "found": screening,
        "ahead": f"{screening.horizon} samples ({figure(1e3 * screening.horizon / screening.rate_hz)} ms)",
        "kept": tables.kept_table(screening),
        "dropped": tables.dropped_table(screening),
        "flags": tables.flags_table(screening),
        "ranges": tables.ranges_table(screening),
        "lags": tables.lags_table(screening),
        "clusters": tables.clusters_table(screening),
        "stages": tables.stages_table(screening),
        "trials": None if trials is None else tables.trials_table(trials),
        "trial_notes": () if trials is None else tuple(trials["notes"]),
        "held_out": () if trials is None else tuple(trials["held_out"]),
        "quality": {} if quality is None else quality_tables(quality),
        "options": sorted((key.replace("_", " "), setting_text(value)) for key, value in screening.options.items()),
        "notes": tuple(notes),
        "window_reason": sentence(screening.proposal.window_reason),
        "seconds": duration(sum(screening.seconds.values())),
    }
    return template("screening.html.jinja").render(**context)


def headline(screening: ScreeningResult) -> str:
    """The proposal in a sentence."""
    proposed, window = len(screening.proposal.kept), screening.proposal.window
    return (
        f"{proposed} of {count_of(len(screening.channels), 'channel')} are proposed to predict "
        f"{listed(screening.targets)}, with a "
        f"memory of {window} samples ({figure(1e3 * window / screening.rate_hz)} ms)."
    )


def verdict(screening: ScreeningResult, quality: DataQuality | None) -> list[str]:
    """What to know before the proposal is used."""
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
    """With a capital in front and a full stop behind."""
    stripped = text.strip()
    return stripped and stripped[0].upper() + stripped[1:] + ("" if stripped.endswith((".", "!", "?")) else ".")


def tiles(screening: ScreeningResult) -> list[tuple[str, str, str]]:
    """Key figures: value, unit, what."""
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
