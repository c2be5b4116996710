"""Task: inputs, outputs, horizons and form of the targets."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np

from edp.data.features import Derived, FeatureSet, column, kind_of
from edp.data.gathered import read_stored_columns
from edp.data.series import Series
from edp.errors import ConfigError, DataError, closest
from edp.recording import MACHINE, FloatArray, Recording
from edp.settings.bounds import MAX_HORIZONS, MAX_NAMES, MOST_TICKS, above, check_bounds, check_count, integer
from edp.signals import Kind
from edp.wording import typed


class TargetMode(StrEnum):
    """Target encoding of the network (thesis 3.2.1): the value itself, or its change from the present value."""

    ABSOLUTE = "absolute"
    DELTA = "delta"


CHECKED_ROWS = 65_536
"""Number of rows per block of checked values, so that recordings on disk need little memory."""
MAX_RATE_HZ = 1e6
"""Maximum sample rate of a sensor. Faster clocks count something else."""


class Ends(Protocol):
    """Interface common to a task and its settings."""

    @property
    def targets(self) -> tuple[str, ...]: ...
    @property
    def horizons(self) -> tuple[int, ...]: ...
    @property
    def integrate(self) -> tuple[str, ...]: ...
    @property
    def derived_targets(self) -> tuple[Derived, ...]: ...


def check_ends(task: Ends) -> None:
    """Raise ConfigError for targets and horizons that are invalid for any data.

    Raises:
        ConfigError: no targets, one twice, too many, or a horizon out of range.
    """
    if not task.targets:
        raise ConfigError("task: no targets; name at least one channel to predict")
    check_count("task", "horizons", task.horizons, MAX_HORIZONS, least=1)
    check_bounds("task", task, horizons=integer(0, MOST_TICKS))
    for part in ("targets", "integrate"):
        names = getattr(task, part)
        check_count("task", part, names, MAX_NAMES)
        twice = sorted(name for name, count in Counter(names).items() if count > 1)
        if twice:
            raise ConfigError(f"task: {part} names {', '.join(twice)} twice; keep one entry each")
    check_count("task", "derived_targets", task.derived_targets, MAX_NAMES)


@dataclass(frozen=True)
class Task:
    """Predict `targets` at ``t + k`` for every k of `horizons` from the inputs up to and including t.

    Attributes:
        features: the feature set.
        targets: names of logged or derived channels.
        horizons: prediction horizons in samples, increasing; 0 estimates the present value from the inputs alone
            (simulation).
        mode: absolute or delta encoding.
        rate_hz: samples per second of every recording.
        derived_targets: derived channels that serve as targets only.
        integrate: targets at horizon 0 whose running integral is also evaluated. For an integrating plant, the rate (a
            velocity) is predicted and then integrated to a position.
        physics: additional logged channels that only a physics base reads. They are not features, and baselines do not
            read them.

    Raises:
        ConfigError: a horizon or combination that cannot hold.
    """

    features: FeatureSet
    targets: tuple[str, ...]
    horizons: tuple[int, ...]
    mode: TargetMode
    rate_hz: float
    derived_targets: tuple[Derived, ...] = ()
    integrate: tuple[str, ...] = ()
    physics: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_ends(self)
        check_bounds("task", self, rate_hz=above(0.0, MAX_RATE_HZ))
        if list(self.horizons) != sorted(set(self.horizons)):
            raise ConfigError(
                f"task: horizons = {list(self.horizons)}; samples >= 0, increasing, each once, at least one"
            )
        for entry in self.derived:
            entry.ticks(self.rate_hz)  # a span that the rate does not allow fails here
        blind = [name for name in self.targets if name not in self.features.lasting]
        if self.mode is TargetMode.DELTA and blind:
            raise ConfigError(
                f"task: mode = 'delta' predicts the change from the present value, but {', '.join(blind)} is not a "
                f"feature{closest(blind[0], self.features.lasting)}; add it to the features or set mode = 'absolute'"
            )
        seen = [name for name in self.targets if name in self.features.lasting]
        if 0 in self.horizons and seen:
            raise ConfigError(
                f"task: horizon 0 asks for the present value of {', '.join(seen)}, which is also a feature; "
                "remove it from the features or ask for horizons >= 1"
            )
        for target in self.integrate:
            if target not in self.targets:
                raise ConfigError(f"task: integrate names '{target}', not a target{closest(target, self.targets)}")
        twice = [name for name in self.physics if name in self.features.inputs or self.physics.count(name) > 1]
        if twice:
            raise ConfigError(f"task: physics names {', '.join(twice)}, which is read already; keep one entry each")
        if self.integrate and 0 not in self.horizons:
            raise ConfigError("task: integrate judges a free run, which needs horizon 0; add it to horizons")

    @property
    def inputs(self) -> tuple[str, ...]:
        """Logged channels required at each sample: channels of the features, then channels of the physics base."""
        return self.features.inputs + self.physics

    @property
    def derived(self) -> tuple[Derived, ...]:
        """Every derived channel of the task."""
        return self.features.derived + self.derived_targets

    @property
    def max_horizon(self) -> int:
        """The largest horizon in samples."""
        return max(self.horizons)

    @property
    def present(self) -> tuple[int | None, ...]:
        """For each target the feature column that holds its present value, None where it is not measured."""
        names = self.features.lasting
        return tuple(names.index(target) if target in names else None for target in self.targets)

    def kinds(self, recording: Recording | None = None) -> tuple[Kind, ...]:
        """Return the kind of each target."""
        return tuple(kind_of(name, recording, self.derived) for name in self.targets)

    def series(self, recording: Recording, start: int = 0, stop: int | None = None, name: str | None = None) -> Series:
        """Return the segment ``start:stop`` of a recording as inputs and targets.

        Raises:
            DataError: another rate, a missing channel, or a value that is not finite.
        """
        # A thousandth: loggers state the same rate with different digits.
        if abs(recording.rate_hz - self.rate_hz) > 1e-3 * self.rate_hz:
            raise DataError(
                f"recording '{recording.name}' has {typed(recording.rate_hz)} Hz, the task {typed(self.rate_hz)} "
                "Hz; all rates "
                "must be equal: set rate_hz in the signal map"
            )
        missing = [name for name in self.physics if name not in recording.channel_names]
        if missing:
            raise DataError(
                f"recording '{recording.name}' ({recording.source}) lacks {', '.join(missing)}, which the physics base "
                "reads; map the columns that hold them (rad, rad/s, m), choose another pose for the base ('angles' or "
                "'strokes'), or remove model.physics"
            )
        if recording.on_disk:
            # What a store keeps on disk is not copied into memory.
            inputs = read_stored_columns(recording, self.inputs, (), start, stop)
            targets = read_stored_columns(recording, self.targets, self.derived, start, stop)
        else:
            rows = slice(start, stop)
            inputs = np.ascontiguousarray(recording.select(self.inputs)[rows])
            columns = [column(recording, target, self.derived)[rows] for target in self.targets]
            targets = np.stack(columns, axis=1)
        for values, names in ((inputs, self.inputs), (targets, self.targets)):
            first_bad = first_not_finite(values)
            if first_bad is not None:
                row, which = first_bad
                raise DataError(
                    f"recording '{recording.name}' ({recording.source}): channel '{names[which]}' has "
                    f"{int((~np.isfinite(values[:, which])).sum())} missing or infinite value(s), the first at row "
                    f"{start + row}; repair the log or allow a repair (--repair nan=hold)"
                )
        machine = str(recording.meta.get(MACHINE, "")).lower()
        return Series(name or recording.name, inputs, targets, machine=machine, recording=recording.name)


def first_not_finite(values: FloatArray) -> tuple[int, int] | None:
    """Return row and column of the first value that is NaN or infinite; None if all are finite."""
    for start in range(0, len(values), CHECKED_ROWS):
        bad = ~np.isfinite(values[start : start + CHECKED_ROWS])
        if bad.any():
            row, which = (int(i) for i in np.argwhere(bad)[0])
            return start + row, which
    return None
