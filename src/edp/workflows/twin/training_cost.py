"""Processor time of a training on free runs, counted from its work: a budget then chooses the same on any machine."""

from __future__ import annotations

from edp.data.twin_channels import TwinChannels
from edp.networks.twin.recurrent import Recurrent
from edp.training.free_run import FreeRunSpec

PER_UPDATE_S, PER_WEIGHT_S, PER_UNIT_S = 3.5e-3, 1e-10, 3.5e-8
"""Of an update; and of a tick of one run forward and back, for each weight and for each unit.

Fitted by hand to trainings of one desktop core: 32 units at 10, 100 and 129 Hz (77, 438, 74 to 87 s for five members)
and 96 units on M22 (347 s); within 15 % of these. Another machine takes another time for the same work."""


def training_seconds(form: Recurrent, channels: TwinChannels, training: FreeRunSpec, members: int) -> float:
    """Return the processor time (s) to train `members` members of a form, without early stopping."""
    units, answers = form.alone().units, len(channels.answers)
    weights = 3 * units * (len(channels.commands) + answers + units) + units * answers
    ticks = sum(
        count * (form.prefix_ticks + round(length * channels.rate_hz))
        for count, length in zip(training.updates, training.lengths_s, strict=True)
    )
    each = ticks * training.batch * (PER_WEIGHT_S * weights + PER_UNIT_S * units)
    return members * (sum(training.updates) * PER_UPDATE_S + each)
