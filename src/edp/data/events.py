"""Counts over a data set: reversals, dead-band crossings, axes in use together, end contacts, recorded events."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.roles import Axis, signed
from edp.recording import Recording

Array = NDArray[np.float64]
RECORDED = {
    "relief": "Event_Relief",
    "cavitation": "Event_Cavitation",
    "regeneration": "Event_Regeneration",
    "power limit": "Event_PowerLimit",
    "soil contact": "Event_SoilContact",
}
"""Events that only a simulation or a special logger records, and their channels."""
CONTACT = 2e-3
"""Distance from an end stop that counts as contact, m."""


@dataclass(frozen=True)
class Activity:
    """Activity of one axis: counts of its commands over the data set.

    Attributes:
        reversals: changes of the sign of a command that left the dead band.
        crossings: times the command left its dead band, in either direction.
        active: fraction of the time outside the dead band.
    """

    axis: str
    reversals: int | None
    crossings: int | None
    active: float | None


@dataclass(frozen=True)
class RareEvent:
    """Rare event; `count` and `share` (fraction of the time) are None if the needed channel is not recorded."""

    name: str
    count: int | None
    share: float | None
    note: str = ""


def rises(on: NDArray[np.bool_]) -> int:
    """Return how often a condition becomes true; once more where it begins true."""
    return int(np.count_nonzero(on[1:] & ~on[:-1]) + bool(len(on) and on[0]))


def reversals(command: Array, threshold: float) -> int:
    """Count sign changes of a command between samples at which the command exceeds the threshold."""
    # Samples within the dead band are left out, so that noise about zero is no reversal.
    signs = np.sign(command[np.abs(command) > threshold])
    return int(np.count_nonzero(signs[1:] != signs[:-1]))


def thresholds(recordings: Sequence[Recording], axes: Sequence[Axis], dead_band: float) -> list[float]:
    """Return the dead band of each axis in units of its command."""
    return [
        dead_band * max(float(np.abs(axis.read_signed_command(r)).max()) for r in recordings) if axis.command else 0.0
        for axis in axes
    ]


def activity_of(recordings: Sequence[Recording], axes: Sequence[Axis], dead_band: float) -> tuple[Activity, ...]:
    """Return the activity of each axis."""
    activity = []
    for axis, level in zip(axes, thresholds(recordings, axes, dead_band), strict=True):
        turned = crossed = active = None
        if axis.command:
            commands = [axis.read_signed_command(r) for r in recordings]
            turned = sum(reversals(u, level) for u in commands)
            crossed = sum(rises(u > level) + rises(-u > level) for u in commands)
            active = sum(int(np.count_nonzero(np.abs(u) > level)) for u in commands) / sum(len(u) for u in commands)
        activity.append(Activity(axis.name, turned, crossed, active))
    return tuple(activity)


def together(recordings: Sequence[Recording], axes: Sequence[Axis], dead_band: float) -> dict[str, float]:
    """Share of the time by how many axes are commanded at once, and with conflux.

    ``both pumps shared``: a second (conflux) spool is commanded while another axis is, so that axes share a pump.
    """
    commanded = [axis for axis in axes if axis.command]
    if not commanded or len({axis.command for axis in commanded}) < len(commanded):
        return {}
    levels = thresholds(recordings, commanded, dead_band)
    on = np.concatenate(
        [
            np.stack([np.abs(a.read_signed_command(r)) > x for a, x in zip(commanded, levels)], axis=1)
            for r in recordings
        ]
    )
    count = on.sum(axis=1)
    shares = {f"{n} axes" if n != 1 else "1 axis": float((count == n).mean()) for n in range(len(commanded) + 1)}
    if all(axis.conflux for axis in commanded):
        flows = [np.concatenate([np.abs(signed(r, axis.conflux)) for r in recordings]) for axis in commanded]
        # A flow that is always zero is never above its dead band.
        second = np.stack([flow > dead_band * max(flow.max(), 1e-12) for flow in flows], axis=1)
        shares["conflux in use"] = float(second.any(axis=1).mean())
        shares["both pumps shared"] = float((second & (count > 1)[:, None]).any(axis=1).mean())
    return shares


def events_of(recordings: Sequence[Recording], ends: Mapping[str, tuple[float, float]] | None) -> tuple[RareEvent, ...]:
    """Return the contacts with the ends of the strokes and recorded events.

    Args:
        recordings: the data set.
        ends: channel of each stroke with its shortest and longest length, m; None where they are not known.
    """
    events = [_contacts(recordings, ends)]
    for name, channel in RECORDED.items():
        if channel not in recordings[0].channel_names:
            events.append(RareEvent(name, None, None, "not recorded"))
            continue
        flags = [r.column(channel) > 0.5 for r in recordings]
        events.append(RareEvent(name, sum(rises(on) for on in flags), float(np.concatenate(flags).mean())))
    return tuple(events)


def _contacts(recordings: Sequence[Recording], ends: Mapping[str, tuple[float, float]] | None) -> RareEvent:
    if not ends:
        return RareEvent("end contact", None, None, "needs the strokes and their full lengths")
    low, high = (np.array([span[side] for span in ends.values()]) for side in (0, 1))
    strokes = [r.select(list(ends)) for r in recordings]
    touched = [(x < low + CONTACT) | (x > high - CONTACT) for x in strokes]
    count = sum(rises(flags[:, i]) for flags in touched for i in range(flags.shape[1]))
    return RareEvent("end contact", count, float(np.concatenate(touched).any(axis=1).mean()))
