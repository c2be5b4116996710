"""How the preset auto divides recordings that no setting divides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edp.data.even_split import blocks_where_time_is_uneven, is_even, moving_ticks
from edp.data.splits import ByRecording, ByTime
from edp.recording import Recording
from edp.wording import typed
from edp.workflows.auto.candidates import LEAST_SPAN
from edp.workflows.auto.settings import AutoSettings

LEAST_DIVIDED = 14
"""Gaps that a recording is long of which 15 % are two of them."""


def divide(recordings: Sequence[Recording], settings: AutoSettings) -> tuple[AutoSettings, list[str]]:
    """Settings with a split whose every part has data and motion, and what it is in words where it is unusual.

    Whole recordings stay whole. A single one, or recordings of such different lengths that a part would have next to
    nothing, are divided by time; by blocks where the end would say nothing of the rest: where the machine rests in a
    part, or moves far less or far more than before.
    """
    split = settings.split
    if not isinstance(split, ByRecording) or split.validation or split.test:
        return settings, []
    gap = LEAST_SPAN + max(settings.task.horizons)
    channels = _channels(settings)
    every = [np.ones(recording.samples, dtype=bool) for recording in recordings]
    by_time = ByTime(validation_share=split.validation_share, test_share=split.test_share)
    if len(recordings) > 1:
        # Of equal recordings that are too short to be divided nothing would be left to validate.
        if all(recording.samples < LEAST_DIVIDED * gap for recording in recordings):
            return settings, []
        moving = moving_ticks(recordings, channels, max(1, *settings.task.horizons))
        if is_even(split, recordings, gap, every) and is_even(split, recordings, gap, moving):
            return settings, []
        by_time = replace(by_time, whole_short=True)
    uneven = blocks_where_time_is_uneven(recordings, channels, settings.task.horizons, by_time)
    if uneven is not None:
        blocks, why = uneven
        return replace(settings, split=blocks), [
            f"{why[0].upper()}{why[1:]}: blocks of {typed(blocks.block_s, 3)} s test in turn (split.kind decides "
            "otherwise)."
        ]
    return replace(settings, split=by_time), []


def _channels(settings: AutoSettings) -> list[str]:
    """Logged channels that the targets are, or are derived from."""
    task = settings.task
    derived = () if isinstance(task.features, str) else task.features.derived
    sources = {entry.name: entry.source for entry in (*derived, *task.derived_targets)}
    return list(dict.fromkeys(sources.get(target, target) for target in task.targets))
