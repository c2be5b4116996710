"""Evaluated data of a run: held-out recordings or other ones, whole or evenly spread segments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from edp.data.prepared import Prepared
from edp.data.spread_rows import spread_series
from edp.logs.drawn import Drawn, check_hours, draw_recordings
from edp.recording import STRETCH_S, Recording
from edp.training.bundle import Bundle


def judged_data(
    bundle: Bundle, data: Prepared, others: Sequence[Recording] | None, at_most_h: float | None
) -> tuple[Prepared, Drawn | None]:
    """Return a run's data with the evaluated ones as test part, and the sampled amount; None if all are evaluated.

    Args:
        bundle: bundle of the run.
        data: data of the run.
        others: other recordings; None for the held-out ones.
        at_most_h: evenly spread segments of so many hours, about, where there are more; None for all.

    Raises:
        EdpError: recordings that do not go with the run, or no positive number of hours.
    """
    hour, length = 3600.0 * bundle.task.rate_hz, round(STRETCH_S * bundle.task.rate_hz)
    lengths = [part.samples for part in (data.test if others is None else others)]
    whole = sum(lengths)
    most = whole if at_most_h is None else max(1, round(hour * check_hours(at_most_h)))
    if others is not None:
        # Before they are made inputs and targets: of a store only what is judged is read.
        chosen = others if at_most_h is None else draw_recordings(others, at_most_h)
        data = replace(data, test=[bundle.task.series(recording) for recording in chosen])
    elif whole > most:
        data = replace(data, test=spread_series(data.test, length, most, on_disk=True))
    # What is left between two stretches at the end of a recording: the shortest one decides the history of baselines.
    least = min(length, *lengths)
    data = replace(data, test=[part for part in data.test if part.samples >= least])
    ticks = sum(part.samples for part in data.test)
    return data, None if ticks == whole else Drawn(ticks / hour, whole / hour, len(data.test))
