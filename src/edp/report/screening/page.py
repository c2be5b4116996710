"""One offline HTML page of a screening: which channels to feed a model, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from edp.data.screening import FlagKind, ScreeningResult
from edp.logs import DataQuality
from edp.report.common.templates import template
from edp.report.common.wording import duration, listed, number, unbroken, whole
from edp.report.coverage.quality import quality_tables
from edp.report.run.page import shown
from edp.report.screening import tables as tables
from edp.report.screening.plots import screening_plots
from edp.report.screening.views import best_groups, joined
from edp.storage import write_bytes


def build_screening_page(
    found: ScreeningResult,
    output: str | Path,
    title: str,
    quality: DataQuality | None = None,
    trials: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
) -> Path:
    """Write a screening as one HTML file that opens with no network.

    Args:
        found: the screening.
        output: where to write.
        title: name of the data set.
        quality: how good its recordings are.
        trials: errors of a network on several feature sets (`edp.workflows.feature_selection.trials.Trials.to_json`).
        notes: what a reader must know of how the data were read.

    Raises:
        StorageError: the page cannot be written.
    """
    target = Path(output)
    write_bytes(target, render_screening(found, title, quality, trials, notes).encode("utf-8", "replace"))
    return target


def render_screening(
    found: ScreeningResult,
    title: str,
    quality: DataQuality | None = None,
    trials: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
) -> str:
    """The page's text."""
    plots = screening_plots(found)
    hours = found.samples / found.rate_hz / 3600
    context: dict[str, Any] = {
        "title": title,
        "size": f"{len(found.recordings)} recording{'s' * (len(found.recordings) != 1)}, {number(hours, 2)} h at "
        f"{found.rate_hz:g} Hz",
        "headline": unbroken(headline(found)),
        "verdict": verdict(found, quality),
        "tiles": tiles(found),
        **shown(plots),
        "found": found,
        "ahead": f"{found.horizon} samples ({1e3 * found.horizon / found.rate_hz:g} ms)",
        "kept": tables.kept_table(found),
        "dropped": tables.dropped_table(found),
        "flags": tables.flags_table(found),
        "ranges": tables.ranges_table(found),
        "lags": tables.lags_table(found),
        "clusters": tables.clusters_table(found),
        "stages": tables.stages_table(found),
        "trials": None if trials is None else tables.trials_table(trials),
        "trial_notes": () if trials is None else tuple(trials["notes"]),
        "held_out": () if trials is None else tuple(trials["held_out"]),
        "quality": {} if quality is None else quality_tables(quality),
        "options": sorted((key, str(value)) for key, value in found.options.items()),
        "notes": tuple(notes),
        "window_reason": sentence(found.proposal.window_reason),
        "seconds": duration(sum(found.seconds.values())),
    }
    return template("screening.html.jinja").render(**context)


def headline(found: ScreeningResult) -> str:
    """The proposal in a sentence."""
    kept, window = len(found.proposal.kept), found.proposal.window
    return (
        f"{kept} of {len(found.channels)} channels are proposed to predict {listed(found.targets)}, with a memory of "
        f"{window} samples ({1e3 * window / found.rate_hz:g} ms)."
    )


def verdict(found: ScreeningResult, quality: DataQuality | None) -> list[str]:
    """What to know before the proposal is used."""
    lines = []
    leaks = sorted({flag.channel for flag in found.flags if flag.kind is FlagKind.LEAK})
    if leaks:
        shown = listed(leaks[:6]) if len(leaks) <= 6 else f"{', '.join(leaks[:6])} and {len(leaks) - 6} more"
        lines.append(f"{shown} know{'s' * (len(leaks) == 1)} the future and must not be fed to a model.")
    groups = [joined(entry.members) for entry in best_groups(found) if entry.low > 0]
    if groups:
        lines.append(f"The forest misses {listed(groups)} most.")
    if quality is not None and quality.repeats:
        lines.append("Some recordings repeat each other: read the section on quality before splitting.")
    if quality is not None and quality.errors:
        lines.append("Some recordings hold errors that were repaired for the screening.")
    return [*lines, *(sentence(note) for note in found.proposal.notes)]


def sentence(text: str) -> str:
    """With a capital in front and a full stop behind."""
    stripped = text.strip()
    return stripped and stripped[0].upper() + stripped[1:] + ("" if stripped.endswith((".", "!", "?")) else ".")


def tiles(found: ScreeningResult) -> list[tuple[str, str, str]]:
    """Key figures: value, unit, what."""
    made = [
        (whole(len(found.proposal.kept)), "", f"of {len(found.channels)} channels proposed"),
        (whole(found.proposal.window), "samples", "suggested memory W"),
    ]
    counts = {kind: len({flag.channel for flag in found.flags if flag.kind is kind}) for kind in FlagKind}
    words = {
        FlagKind.LEAK: "leaks of the future",
        FlagKind.COPY: "delayed copies",
        FlagKind.ARTEFACT: "artefacts of a file",
        FlagKind.NOISE: "channels without any relation",
    }
    made += [(whole(counts[kind]), "", text) for kind, text in words.items() if counts[kind]]
    return made
