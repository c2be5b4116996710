"""k-step-ahead evaluation of a twin with measured ports and given commands, compared with other predictors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.errors import DataError
from edp.evaluation.free_run_file import AheadErrors, ErrorPair
from edp.evaluation.free_run_parts import by_channel, nrmse_by_channel
from edp.networks.twin import Twin

Array = NDArray[np.float32]
EACH = 200
"""Number of start samples per segment: in a dozen recordings the mean error is accurate to one per cent."""


@dataclass(frozen=True, eq=False)
class Ahead:
    """k-step-ahead outputs of a twin and the corresponding measurements.

    Attributes:
        channels: channels of the twin.
        ticks: prediction horizon in samples.
        moments: index of the last measured sample of each prediction, by segment ``(moment,)``.
        answers: ``(moment, output)``, SI units, segment after segment.
        truth: measured, of the same shape.
    """

    channels: TwinChannels
    ticks: int
    moments: tuple[NDArray[np.int64], ...]
    answers: Array
    truth: Array


def look_ahead(twin: Twin, series: Sequence[Series], ticks: int, first: int = 0) -> Ahead:
    """Predict `ticks` samples ahead from evenly spaced samples, measured up to each, with given later commands.

    Args:
        twin: any formulation.
        series: inputs are commands, targets are what it answers.
        ticks: prediction horizon in samples, at least one.
        first: earliest moment in a segment; never before the prefix.

    Raises:
        DataError: no segment is long enough.
    """
    prefix, answers, truths, moments = twin.prefix_ticks, [], [], []
    for part in series:
        earliest, latest = max(first, prefix), part.samples - ticks - 1
        at = np.unique(np.linspace(earliest, latest, EACH).astype(np.int64)) if latest >= earliest else np.zeros(0, int)
        # A start beyond an end stop is one that the twin refuses.
        at = at[twin.is_within_stops(part.targets[at - prefix])]
        moments.append(at)
        if not len(at):
            continue
        before, after = at[:, None] + np.arange(-prefix, 0), at[:, None] + np.arange(ticks)
        state = twin.reset(part.inputs[before], part.targets[before])
        ports = np.full((len(at), ticks, part.targets.shape[1]), np.nan, np.float32)
        ports[:, 0] = part.targets[at]
        answers.append(twin.rollout(part.inputs[after], state, ports)[0][:, -1])
        truths.append(part.targets[at + ticks])
    if not answers:
        raise DataError(
            f"no recording has {max(first, prefix) + ticks + 1} ticks, and a twin that looks {ticks} ticks ahead needs "
            "as many: give longer recordings"
        )
    return Ahead(twin.channels, ticks, tuple(moments), np.concatenate(answers), np.concatenate(truths))


def score_ahead(ahead: Ahead) -> AheadErrors:
    """Return the velocity MAE, stroke error and pressure NRMSE that far ahead, never averaged together."""
    channels = ahead.channels
    errors = np.abs(ahead.answers - ahead.truth).astype(np.float64)
    velocities, strokes = (
        by_channel(channels.answers[columns], errors[:, columns].mean(axis=0))
        for columns in (channels.parts["velocities"], channels.parts["strokes"])
    )
    return AheadErrors(
        ticks=ahead.ticks,
        seconds=ahead.ticks / channels.rate_hz,
        moments=len(ahead.truth),
        velocity_mae=velocities,
        stroke_error=strokes,
        # The scores of pressures read runs and ticks: here each moment is a run of one tick.
        pressure_nrmse=nrmse_by_channel(channels, ahead.answers[:, None], ahead.truth[:, None]),
    )


def predictor_scores(ahead: Ahead, predicted: Mapping[str, Array]) -> dict[str, ErrorPair]:
    """Return the mean absolute errors of a look-ahead predictor at the same moments, by kind of channel.

    Args:
        ahead: k-step-ahead outputs of the twin.
        predicted: predictions of each common output, ``(moment,)``, SI units.
    """
    pairs = {}
    for part, columns in ahead.channels.parts.items():
        named = [(i, c) for i, c in enumerate(ahead.channels.answers) if c in ahead.channels.answers[columns]]
        shared = [(i, c) for i, c in named if c.name in predicted]
        if shared:
            truth = ahead.truth[:, [i for i, _ in shared]]
            chosen = [c for _, c in shared]
            errors = np.abs(np.stack([predicted[c.name] for c in chosen], axis=1) - truth).astype(np.float64)
            own = np.abs(ahead.answers[:, [i for i, _ in shared]] - truth).astype(np.float64)
            pairs[part] = ErrorPair(
                predictor=by_channel(chosen, errors.mean(axis=0)), twin=by_channel(chosen, own.mean(axis=0))
            )
    return pairs
