"""Stretches of recordings for training and evaluation of a twin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edp.config.twin import TwinExperiment
from edp.data.derived_velocities import complete_velocities
from edp.data.integrals import contradiction, integral_fit
from edp.data.prepared import Prepared, prepare
from edp.data.series import Series
from edp.data.splits import FAMILY
from edp.data.twin_channels import TwinChannels, same_channels, twin_channels
from edp.errors import ConfigError, DataError, closest
from edp.logs.source import DataSource
from edp.networks.twin.base import Twin, check_length
from edp.recording import Recording


def prepare_twin(source: DataSource, experiment: TwinExperiment) -> tuple[TwinChannels, Prepared]:
    """Read and cut a data set: commands as inputs, the twin's outputs as targets.

    Raises:
        EdpError: recordings or settings that cannot be used.
    """
    return cut_recordings(source.read(), experiment)


def cut_recordings(recordings: Sequence[Recording], experiment: TwinExperiment) -> tuple[TwinChannels, Prepared]:
    """Cut recordings as `prepare_twin` does; where they hold positions alone, velocities are derived from these.

    Raises:
        EdpError: recordings or settings that cannot be used.
    """
    recordings, settings = complete_velocities(recordings, experiment.channels)
    channels = twin_channels(recordings[0], settings)
    for recording in recordings[1:]:
        same_channels(channels, recording)
    data = prepare(recordings, channels.task(), experiment.split, experiment.twin.prefix_ticks)
    check_length(channels, experiment.twin.prefix_ticks, data.train)
    check_moves(channels, data.train)
    check_integrals(channels, data.train)
    return channels, data


def check_moves(channels: TwinChannels, train: Sequence[Series]) -> None:
    """Refuse recordings in which no command ever moves, from which a twin could learn no response.

    Raises:
        DataError: names the commands.
    """
    moves = [
        np.ptp(np.concatenate([part.inputs[:, column] for part in train])) > 0
        for column in range(len(channels.commands))
    ]
    if not any(moves):
        names = ", ".join(f"'{channel.name}'" for channel in channels.commands)
        raise DataError(
            f"twin: no command ({names}) changes in the training recordings; a twin is driven by commands alone: give "
            "recordings in which at least one moves, or name the commands in channels.commands"
        )


def check_integrals(channels: TwinChannels, train: Sequence[Series]) -> None:
    """Refuse strokes that are not the integrals of their velocities, which a twin assumes.

    Raises:
        DataError: names both channels and the ratio.
    """
    count = len(channels.velocities)
    for which, (velocity, stroke) in enumerate(zip(channels.velocities, channels.strokes, strict=False)):
        pairs = [(series.targets[:, which], series.targets[:, count + which]) for series in train]
        fit = integral_fit(pairs, channels.rate_hz)
        if fit.contradicts:
            raise DataError(f"{contradiction(velocity.name, stroke.name, fit)}; or leave out all velocities")


def driving_labels(recordings: Sequence[Recording]) -> dict[str, str]:
    """Return the way of driving by name of recording; empty if a recording does not state it."""
    labels = {recording.name: str(recording.meta.get(FAMILY, "")) for recording in recordings}
    return labels if all(labels.values()) else {}


def answer_columns(twin: Twin, names: Sequence[str], option: str) -> list[int]:
    """Return the columns of channels among the outputs of a twin.

    Raises:
        ConfigError: a channel of the command-line option is not an output.
    """
    answers = [channel.name for channel in twin.channels.answers]
    for name in names:
        if name not in answers:
            raise ConfigError(f"{option} {name}: the twin does not answer this channel{closest(name, answers)}")
    return [answers.index(name) for name in names]
