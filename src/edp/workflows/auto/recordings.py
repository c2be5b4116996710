"""From recordings to prepared data: task on the available channels, division into parts, checks of motion and size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edp.config.experiment import FeatureSettings
from edp.data.even_split import blocks_where_time_is_uneven, is_even, moving_ticks
from edp.data.features import FEATURE_SETS, Derived
from edp.data.prepared import Prepared
from edp.data.scaling import least_spread
from edp.data.splits import ByRecording, ByTime
from edp.data.task import TargetMode
from edp.errors import ConfigError, DataError
from edp.logs.source import DataSource
from edp.networks.backbones import CommitteeSpec
from edp.networks.heads import LinearHead
from edp.networks.predictor import ModelSpec
from edp.recording import FloatArray, Recording
from edp.signals import Kind
from edp.storage.memory import check_setting
from edp.training.spec import TrainingSpec
from edp.wording import typed
from edp.workflows.auto.candidates import MIN_SPAN, Amount, Foundation
from edp.workflows.auto.settings import AutoSettings
from edp.workflows.train_evaluate import prepare_data

USUAL = "FG2"
"""The feature set that is taken without a word where the recordings have its channels."""
MAX_LISTED = 20
"""Channels that a message lists."""
AXES = range(1, 4)
SOURCES = {
    **{f"CylVels_{axis}": (f"CylStroke_{axis}", Kind.VELOCITY) for axis in AXES},
    **{f"CylAcc_{axis}": (f"CylVels_{axis}", Kind.ACCELERATION) for axis in AXES},
}
"""Of which channel a channel is the derivative, and its kind."""
MIN_DIVIDED = 14
"""Gaps that a recording is long of which 15 % are two of them."""
COPIES = 8
"""Of what is predicted at each tick, in double precision: the truth, and what each candidate said of it."""
MOST_TICKS = 0.9
"""Share of the ticks whose segments settle how far changes reach back: a short log among long ones shortens none."""


def fit_to_channels(settings: AutoSettings, names: Sequence[str], where: str) -> tuple[AutoSettings, list[str]]:
    """Return settings with a task on the channels of the recordings, and the changes in sentences.

    Args:
        settings: settings of the run.
        names: channels of the recordings.
        where: they come from.

    Raises:
        ConfigError: a target is no channel of the recordings, and cannot be derived.
    """
    task = settings.task
    notes: list[str] = []
    if task.features == USUAL and not set(FEATURE_SETS[USUAL].inputs) <= set(names):
        features, notes = _choose_features(names)
        task = replace(task, features=features)
    derived = () if isinstance(task.features, str) else task.features.derived
    channels = {*names, *(entry.name for entry in (*derived, *task.derived_targets))}
    absent = [target for target in task.targets if target not in channels]
    if absent:
        listed = ", ".join(names[:MAX_LISTED]) + (", ..." if len(names) > MAX_LISTED else "")
        raise ConfigError(
            f"task.targets: {', '.join(absent[:MAX_LISTED])} is no channel of '{where}', which has {listed}; "
            f"name what to predict, for example --set 'task.targets=[\"{names[-1]}\"]'"
        )
    return replace(settings, task=task), notes


def _choose_features(names: Sequence[str]) -> tuple[str | FeatureSettings, list[str]]:
    """Return the usual features, if they are present or can be derived; all channels otherwise."""
    usual = FEATURE_SETS[USUAL]
    missing = [name for name in usual.inputs if name not in names]
    derived = [
        Derived(name, SOURCES[name][0], "derivative", SOURCES[name][1])
        for name in missing
        if name in SOURCES and SOURCES[name][0] in names
    ]
    if not derived:
        return "all", []  # a machine of another kind
    notes = [f"Derived by EDP: {', '.join(f'{one.name} from {one.source}' for one in derived)}."]
    lost = [name for name in missing if name not in {one.name for one in derived}]
    if lost:
        notes.append(f"Of the usual channels {', '.join(lost)} are not there: every channel of the logs is read.")
        return FeatureSettings(name="all", channels=tuple(names), derived=tuple(derived)), notes
    channels = tuple(name for name in usual.channels if name in names)
    hidden = tuple(dict.fromkeys(one.source for one in derived if one.source not in channels))
    return FeatureSettings(name=USUAL, channels=channels, derived=(*usual.derived, *derived), hidden=hidden), notes


def divide(recordings: Sequence[Recording], settings: AutoSettings) -> tuple[AutoSettings, list[str]]:
    """Return settings with a split whose every part has data and motion, and a sentence if the split is unusual.

    Whole recordings stay whole. A single one, or recordings of such different lengths that a part would have next to
    nothing, are divided by time; by blocks where the end would say nothing of the rest: where the machine rests in a
    part, or moves far less or far more than before.
    """
    split = settings.split
    if not isinstance(split, ByRecording) or split.validation or split.test:
        return settings, []
    gap = MIN_SPAN + max(settings.task.horizons)
    task = settings.task
    derived = () if isinstance(task.features, str) else task.features.derived
    sources = {entry.name: entry.source for entry in (*derived, *task.derived_targets)}
    # Logged channels: the targets, or the channels that they are derived from.
    channels = list(dict.fromkeys(sources.get(target, target) for target in task.targets))
    every = [np.ones(recording.samples, dtype=bool) for recording in recordings]
    by_time = ByTime(validation_fraction=split.validation_fraction, test_fraction=split.test_fraction)
    if len(recordings) > 1:
        # Of equal recordings that are too short to be divided nothing would be left to validate.
        if all(recording.samples < MIN_DIVIDED * gap for recording in recordings):
            return settings, []
        moving = moving_ticks(recordings, channels, max(1, *task.horizons))
        if is_even(split, recordings, gap, every) and is_even(split, recordings, gap, moving):
            return settings, []
        by_time = replace(by_time, train_short_recordings=True)
    uneven = blocks_where_time_is_uneven(recordings, channels, task.horizons, by_time)
    if uneven is not None:
        blocks, why = uneven
        return replace(settings, split=blocks), [
            f"{why[0].upper()}{why[1:]}: blocks of {typed(blocks.block_s, 3)} s test in turn (split.kind decides "
            "otherwise)."
        ]
    return replace(settings, split=by_time), []


class ReadOnce:
    """Data source that reads its recordings once, at the first request."""

    def __init__(self, source: DataSource) -> None:
        self.path, self._source = source.path, source
        self._recordings: list[Recording] = []

    def read(self) -> list[Recording]:
        """Return the recordings."""
        self._recordings = self._recordings or self._source.read()
        return self._recordings

    def to_dict(self) -> dict[str, object]:
        """Return the plain values of the source."""
        return self._source.to_dict()


def prepare(source: ReadOnce, settings: AutoSettings, foundation: Foundation | None) -> tuple[Prepared, Amount]:
    """Return the data, cut for the common window of the candidates, and their amount."""

    def cut(window: int) -> tuple[Prepared, Amount]:
        model = ModelSpec(window=window, backbone=CommitteeSpec(), head=LinearHead())
        data = prepare_data(source, settings.experiment(model, TrainingSpec()))
        reach = data.task.max_horizon
        # A stretch that ends within the horizon holds nothing to predict; the digest stays that of all recordings.
        train, validation = (
            [part for part in stretches if part.samples > reach] for stretches in (data.train, data.validation)
        )
        if not train or not validation:
            raise DataError(
                f"automatic choice: no stretch of the training or of the validation part is longer than the largest "
                f"horizon of {reach} ticks; give longer recordings or a shorter horizon"
            )
        data = replace(data, train=train, validation=validation)
        parts = [*train, *validation]
        falling = np.sort([part.samples for part in parts])[::-1]
        auto = settings.auto
        return data, Amount(
            rows=sum(part.samples for part in parts),
            shortest=min(part.samples for part in parts),
            usual=int(falling[np.searchsorted(falling.cumsum(), MOST_TICKS * falling.sum())]),
            features=len(data.task.features.features),
            outputs=len(data.task.horizons) * len(data.task.targets),
            horizon=data.task.max_horizon,
            minutes=auto.time_budget_min,
            seed=auto.seed,
            threads=auto.threads,
            foundation=foundation,
            changes=data.task.mode is TargetMode.DELTA,
        )

    try:
        data, amount = cut(MIN_SPAN + 1)
    except DataError:
        data, amount = cut(1)  # recordings of seconds: shorter spans will do
    if amount.window != MIN_SPAN + 1:
        data, final = cut(amount.window)
        amount = replace(amount, rows=final.rows)
    return data, amount


def check_moving(data: Prepared) -> None:
    """Check that the targets and an input move.

    Raises:
        DataError: a target or all inputs never move in the training part.
    """
    still = [
        name
        for name, moves in zip(
            data.task.targets, _moving([part.targets for part in data.train], data.target_kinds), strict=True
        )
        if not moves
    ]
    if still:
        raise DataError(
            f"the target {', '.join(still)} never moves in the training part; there is nothing to learn of it: take it "
            "out of task.targets, or record it while the machine works"
        )
    if not any(_moving([part.inputs for part in data.train], [channel.kind for channel in data.inputs])):
        raise DataError(
            "no input moves in the training part; a model of these recordings could only repeat a constant: record "
            "while the machine works, or check the signal map"
        )


def still_inputs(data: Prepared) -> list[str]:
    """Return a sentence with the inputs that do not move in the training part; empty if all move."""
    moving = _moving([part.inputs for part in data.train], [channel.kind for channel in data.inputs])
    still = [channel.name for channel, moves in zip(data.inputs, moving, strict=True) if not moves]
    if not still:
        return []
    more = f" and {len(still) - MAX_LISTED} more" if len(still) > MAX_LISTED else ""
    return [f"Still through the training part, so without weight: {', '.join(still[:MAX_LISTED])}{more}."]


def _moving(parts: Sequence[FloatArray], kinds: Sequence[Kind]) -> list[bool]:
    """Test whether each channel moves in segments ``(time, channel)``, relative to its own size."""
    values = np.concatenate(parts).astype(np.float64)
    spreads, sizes = values.std(axis=0), np.abs(values).max(axis=0)
    return [spread > least_spread(kind, size) for spread, size, kind in zip(spreads, sizes, kinds, strict=True)]


def check_size(data: Prepared) -> None:
    """Refuse data that do not fit into memory: every candidate is compared on every tick.

    Raises:
        ConfigError: says what it would take, what is free, and what to do.
    """
    ticks = sum(part.samples for part in (*data.train, *data.validation))
    outputs = len(data.task.horizons) * len(data.task.targets)
    check_setting(
        8 * COPIES * ticks * outputs,
        f"the preset auto, which compares its candidates on all {typed(ticks / data.task.rate_hz / 3600)} h of "
        "training",
        "train with --preset standard, which reads a store piece by piece, or give a data-set file of some logs",
    )
