"""Data set prepared for a task: the series of each part, and a digest of the inputs."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

from edp.data.features import STARTING, kind_of
from edp.data.scaling import Scaler, fit_scaler
from edp.data.series import Series
from edp.data.splits import SplitSpec, Stretch
from edp.data.task import Task
from edp.recording import Recording
from edp.signals import Channel, Kind


@dataclass(frozen=True, eq=False)
class Prepared:
    """Series of each part of the split, with the kinds of their channels.

    Attributes:
        task: channels to read and to predict.
        train: training segments.
        inputs: the logged input channels.
        feature_kinds: kind of each feature, in order.
        target_kinds: kind of each target.
        descriptions: description of each target.
        digest: blake2b over the recordings and segments.
    """

    task: Task
    train: list[Series]
    validation: list[Series]
    test: list[Series]
    inputs: tuple[Channel, ...]
    feature_kinds: tuple[Kind, ...]
    target_kinds: tuple[Kind, ...]
    descriptions: tuple[str, ...]
    digest: str

    def scaler(self) -> Scaler:
        """Return a scaler fitted to the training segments only."""
        return fit_scaler(self.task, self.train, self.feature_kinds)


def prepare(recordings: Sequence[Recording], task: Task, split: SplitSpec, window: int) -> Prepared:
    """Cut recordings into the series of each part.

    Args:
        recordings: the data set, all at the rate of the task.
        task: channels to read and to predict.
        split: division of the recordings.
        window: window length W in samples; the gap between neighbouring segments is ``W + k``.

    Raises:
        DataError: a channel is missing, a value is not finite, rates differ, or a part would be empty.
    """
    first = recordings[0]
    parts = split.split(recordings, window + task.max_horizon)
    state = hashlib.blake2b(digest_size=16)
    for recording in recordings:
        state.update(recording.digest.encode())
    # The split is part of the inputs: the same recordings with another split are other data.
    state.update(repr(parts).encode())

    def series(stretches: Sequence[Stretch]) -> list[Series]:
        prepared_series = []
        for stretch in stretches:
            recording = recordings[stretch.recording]
            whole = stretch.start == 0 and stretch.stop == recording.samples
            name = recording.name if whole else f"{recording.name}[{stretch.start}:{stretch.stop}]"
            prepared_series.append(task.series(recording, stretch.start, stretch.stop, name))
        return prepared_series

    return Prepared(
        task=task,
        train=series(parts.train),
        validation=series(parts.validation),
        test=series(parts.test),
        inputs=tuple(first.channels[first.index(name)] for name in task.inputs),
        feature_kinds=tuple(
            Kind.GENERIC if name == STARTING else kind_of(name, first, task.derived) for name in task.features.features
        ),
        target_kinds=task.kinds(first),
        descriptions=tuple(_description(first, name) for name in task.targets),
        digest=state.hexdigest(),
    )


def _description(recording: Recording, name: str) -> str:
    if name in recording.channel_names:
        return recording.channels[recording.index(name)].description
    return ""
