"""Separation of a recurrent twin into members, and its re-scaling for recordings of another machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from edp.data.roles import roles_of_channels
from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.networks.twin.recurrent import RecurrentTwin
from edp.networks.twin.recurrent_cell import TwinNetwork
from edp.networks.twin.scales import TwinScales
from edp.networks.twin.static_map import StaticTwin

AT_STOP = 0.002
"""Fraction of a stroke within which two outermost positions count as equal: a few millimetres."""
APART_S = 1.0
"""Minimum time away from an outermost position before a further visit counts as a new visit, s."""
VISITS = 2
"""Minimum number of visits to the same outermost position that identify an end stop. Reversals within the stroke rarely
occur at equal positions."""
PUSHED_S = 1.0
"""Minimum time at an outermost position with the lever pushing outwards that identifies an end stop at the first visit,
s."""
PUSHED = 0.5
"""Minimum command, as a fraction of the largest command, that would move an actuator at any position except an end
stop."""


def scales_for(twin: RecurrentTwin, own: TwinScales, train: list[Series]) -> TwinScales:
    """Return scales for continued training on other recordings: units stay the same, bounds follow the data.

    An end stop is set where the recordings reach the same outermost stroke at least twice, or stay there under command.
    Otherwise the end is the outermost stroke of recordings and twin. Velocities and pressures have the wider bounds of
    both.

    Args:
        twin: trained before.
        own: fitted to these recordings.
        train: segments of these recordings.
    """
    before, count = twin.scales, len(twin.channels.velocities)
    low, high = np.minimum(before.low, own.low), np.maximum(before.high, own.high)
    for axis in range(len(twin.channels.strokes)):
        which = count + axis
        near = AT_STOP * float(high[which] - low[which])
        pushes = _pushes(twin.channels, axis, train)
        for bound, side in ((low, -1.0), (high, 1.0)):
            end = float((own.low if side < 0.0 else own.high)[which])
            there = [side * (series.targets[:, which] - end) >= -near for series in train]
            if _is_stop(there, [side * push for push in pushes], twin.channels.rate_hz):
                bound[which] = end
    return replace(before, low=low, high=high)


def _is_stop(there: Sequence[np.ndarray], pushes: Sequence[np.ndarray], rate_hz: float) -> bool:
    """Return whether an outermost place is an end stop.

    Args:
        there: mask of the samples at the position, one array per segment.
        pushes: lever command towards the position, as a fraction of its maximum; empty if the lever is unknown.
        rate_hz: sample rate, Hz.
    """
    if sum(_visits(one, round(APART_S * rate_hz)) for one in there) >= VISITS:
        return True
    longest = round(PUSHED_S * rate_hz)
    stays = (one & (push[: len(one)] >= PUSHED) for one, push in zip(there, pushes, strict=False))
    return any(_longest(one) >= longest for one in stays)


def _longest(there: np.ndarray) -> int:
    """Return the number of samples of the longest stay."""
    turns = np.flatnonzero(np.diff(np.concatenate([[0], there.astype(np.int8), [0]])))
    return int((turns[1::2] - turns[::2]).max(initial=0))


def _pushes(channels: TwinChannels, axis: int, train: Sequence[Series]) -> list[np.ndarray]:
    """Return the signed command of an actuator per segment, extension positive, as a fraction of its largest.

    Empty if unknown.
    """
    names = [channel.name for channel in channels.commands]
    every = channels.commands + channels.answers
    axes = {one.velocity: one.command for one in roles_of_channels(every).axes}
    columns = [names.index(name) for name in axes.get(channels.velocities[axis].name, ()) if name in names]
    if not columns:
        return []
    signed = [series.inputs[:, columns[0]] - (series.inputs[:, columns[1]] if columns[1:] else 0.0) for series in train]
    largest = max(float(np.abs(values).max(initial=0.0)) for values in signed)
    return [values / largest for values in signed] if largest > 0.0 else []


def _visits(there: np.ndarray, apart: int) -> int:
    """Count the visits to a place from a mask over the samples of a segment."""
    ticks = np.flatnonzero(there)
    return int(len(ticks) > 0) + int((np.diff(ticks) > apart).sum())


def replace_scales(twin: RecurrentTwin, scales: TwinScales) -> RecurrentTwin:
    """Return a copy of the twin with other bounds."""
    network = _copy_network(twin.network)
    static = twin.static and StaticTwin(twin.channels, scales, twin.prefix_ticks, twin.static.numbers)
    return RecurrentTwin(twin.channels, scales, twin.prefix_ticks, network, static, twin.members)


def separated(twin: RecurrentTwin) -> list[RecurrentTwin]:
    """Return the members of an averaged twin; the twin itself if it is a single network.

    Each member gets the parameters that the average stores only once (constants of the outputs, pulls, the map).
    """
    if len(twin.member_rows()) < twin.members or twin.members == 1:
        return [replace_scales(twin, twin.scales)]
    return [_member(twin, rows) for rows in twin.member_rows()]


def _member(twin: RecurrentTwin, rows: slice) -> RecurrentTwin:
    whole, units = twin.network, rows.stop - rows.start
    pulled = 0 if whole.pull is None else len(whole.pull)
    network = TwinNetwork(len(twin.channels.commands), len(twin.channels.answers), units, pulled)
    gates = torch.cat([torch.arange(rows.start, rows.stop) + gate * whole.units for gate in range(3)])
    with torch.no_grad():
        network.command_weight.copy_(whole.command_weight[gates])
        network.bias.copy_(whole.bias[gates])
        network.feedback_weight.copy_(whole.feedback_weight[:, gates])
        network.h_weight.copy_(whole.h_weight[rows][:, gates])
        network.inner_bias.copy_(whole.inner_bias[rows])
        network.out_weight.copy_(whole.out_weight[rows] * twin.members)
        network.out_bias.copy_(whole.out_bias)
        if network.pull is not None and whole.pull is not None:
            network.pull.copy_(whole.pull)
    static = twin.static and StaticTwin(twin.channels, twin.scales, twin.prefix_ticks, twin.static.numbers)
    return RecurrentTwin(twin.channels, twin.scales, twin.prefix_ticks, network, static)


def _copy_network(network: TwinNetwork) -> TwinNetwork:
    """Return a copy of a network."""
    pulled = 0 if network.pull is None else len(network.pull)
    answers = network.out_bias.shape[0]
    copy = TwinNetwork(network.command_weight.shape[1], answers, network.units, pulled)
    copy.load_state_dict(network.state_dict())
    return copy
