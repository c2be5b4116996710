"""Velocities for logs with positions only: change of each position from sample to sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edp.data.roles import roles_of
from edp.data.twin_channels import INTEGRAL, TwinChannels, TwinChannelSettings, same_channels
from edp.errors import DataError
from edp.recording import Recording
from edp.signals import Channel, Kind

SUFFIX = "_velocity"
"""Suffix added to the name of a position signal to name its rate of change."""
RATE_OF = {integral: velocity for velocity, integral in INTEGRAL.items()}
"""Kind of a rate of change, by the kind of the position signal."""


def complete_velocities(
    recordings: Sequence[Recording], settings: TwinChannelSettings
) -> tuple[list[Recording], TwinChannelSettings]:
    """Add a velocity for each position without a recorded or named velocity, to recordings and settings.

    The positions are the strokes named in the settings, or all positions and angles that are not commands. Recordings
    with a velocity or without a position are returned unchanged.

    Raises:
        DataError: a recording already has a channel with the name of a derived velocity, or lacks a position.
    """
    first = recordings[0]
    _ = roles_of(first, settings.commands)  # a command that is no channel is refused with the closest name
    if settings.velocities or any(channel.kind in INTEGRAL for channel in first.channels):
        return list(recordings), settings
    positions = settings.strokes or tuple(
        channel.name for channel in first.channels if channel.kind in RATE_OF and channel.name not in settings.commands
    )
    kinds = [first.channels[first.index(name)].kind for name in positions]
    if not positions or any(kind not in RATE_OF for kind in kinds):
        return list(recordings), settings
    velocities = tuple(f"{name}{SUFFIX}" for name in positions)
    completed = [_add_velocities(recording, positions) for recording in recordings]
    return completed, replace(settings, velocities=velocities, strokes=positions)


def matched(channels: TwinChannels, recording: Recording) -> Recording:
    """Return the recording with all channels of a twin.

    Velocities that the training derived from positions are derived again.

    Raises:
        DataError: it lacks another channel, or measures one as another kind.
    """
    names = recording.channel_names
    positions = [
        stroke.name
        for velocity, stroke in zip(channels.velocities, channels.strokes, strict=False)
        if velocity.name == f"{stroke.name}{SUFFIX}" and velocity.name not in names and stroke.name in names
    ]
    completed = _add_velocities(recording, positions) if positions else recording
    same_channels(channels, completed)
    return completed


def _add_velocities(recording: Recording, positions: Sequence[str]) -> Recording:
    """Add the backward difference of each position times the sampling rate. The first sample is zero."""
    columns, channels = [recording.values], list(recording.channels)
    for name in positions:
        channel = recording.channels[recording.index(name)]
        if f"{name}{SUFFIX}" in recording.channel_names:
            raise DataError(
                f"recording '{recording.name}' ({recording.source}): the velocity of '{name}' is to be derived, but "
                f"there is a channel '{name}{SUFFIX}' of kind {recording.channels[recording.index(name + SUFFIX)].kind}"
                "; name the velocities in the settings, channels.velocities = [...], or rename this channel"
            )
        position = recording.column(name).astype(np.float64)
        velocity = np.diff(position, prepend=position[:1]) * recording.rate_hz
        columns.append(velocity.astype(np.float32)[:, None])
        kind = RATE_OF.get(channel.kind, Kind.GENERIC)
        channels.append(Channel(f"{name}{SUFFIX}", kind, f"Change of {name} per second"))
    return replace(recording, channels=tuple(channels), values=np.concatenate(columns, axis=1))
