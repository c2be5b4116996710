"""Seeded data augmentation. Each training segment gets a new random change in each epoch; other data stay unchanged."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.registry import Registry
from edp.settings.bounds import MOST_TICKS, above, check_bounds, integer


class AugmentationSpec(Protocol):
    """Options of an augmentation."""

    def apply(self, part: Series, deviation: NDArray[np.float32], rng: np.random.Generator) -> Series:
        """Return an augmented segment of the same length.

        Args:
            part: segment from one reset to the next, including the rows that its last targets need.
            deviation: ``(input,)``, standard deviation of each input in the training data, SI units.
            rng: the only source of chance.
        """
        ...


AUGMENTATIONS: Registry[type] = Registry("augmentation")


@AUGMENTATIONS.register("jitter")
@dataclass(frozen=True, kw_only=True)
class Jitter:
    """White noise on every logged input, as of noisier sensors; targets stay as they were logged.

    Derived features (pressure differences) are made from the noisy inputs, as on a machine. A target in delta mode is
    counted from the noisy present value.

    Attributes:
        std: standard deviation of the noise, in standard deviations of the input.

    Raises:
        ConfigError: std outside ]0, 1].
    """

    std: float = 0.02

    def __post_init__(self) -> None:
        check_bounds("jitter", self, std=above(0.0, 1.0))

    def apply(self, part: Series, deviation: NDArray[np.float32], rng: np.random.Generator) -> Series:
        """Add the noise."""
        noise = rng.standard_normal(part.inputs.shape, dtype=np.float32)
        return replace(part, inputs=part.inputs + noise * (np.float32(self.std) * deviation))


@AUGMENTATIONS.register("window_shift")
@dataclass(frozen=True, kw_only=True)
class WindowShift:
    """Inputs read some samples earlier or later than their targets, as of a log whose delay is not known exactly.

    Attributes:
        max_shift: largest shift in samples, either way.

    Raises:
        ConfigError: most below 1.
    """

    max_shift: int = 2

    def __post_init__(self) -> None:
        check_bounds("window_shift", self, max_shift=integer(1, MOST_TICKS))

    def apply(self, part: Series, deviation: NDArray[np.float32], rng: np.random.Generator) -> Series:
        """Shift all inputs alike; the rows that are missing at one end repeat the last there."""
        shift = int(rng.integers(-self.max_shift, self.max_shift + 1))
        rows = np.clip(np.arange(part.samples) + shift, 0, part.samples - 1)
        return replace(part, inputs=part.inputs[rows])


@AUGMENTATIONS.register("time_warp")
@dataclass(frozen=True, kw_only=True)
class TimeWarp:
    """Time warping: inputs and targets are resampled with a varying speed; both ends of the segment stay in place.

    The speed is one plus three sines of random phase, whose periods lie between a quarter of the segment and the whole.
    Values are interpolated, not scaled: what changes is how fast the plant answers. So are teacher predictions.

    Attributes:
        strength: largest change of the speed.

    Raises:
        ConfigError: strength outside ]0, 0.5].
    """

    strength: float = 0.1

    def __post_init__(self) -> None:
        check_bounds("time_warp", self, strength=above(0.0, 0.5))

    def apply(self, part: Series, deviation: NDArray[np.float32], rng: np.random.Generator) -> Series:
        """Return the segment resampled at warped rows."""
        last = part.samples - 1
        if last < 1:
            return part
        rows = np.arange(part.samples, dtype=np.float64)
        warped = rows.copy()
        for period, phase in zip(last * rng.uniform(0.25, 1.0, 3), rng.uniform(0.0, 2.0 * np.pi, 3), strict=True):
            turn = 2.0 * np.pi / period
            warped += self.strength / (3.0 * turn) * (np.sin(turn * rows + phase) - np.sin(phase))
        # Both ends stay, so that a warped stretch reads no row outside of it.
        warped *= last / warped[-1]
        # The last row is the end of the last interval, so it has a share of one.
        below = np.clip(warped.astype(np.int64), 0, last - 1)
        share = (warped - below).astype(np.float32)[:, None]

        def read(values: NDArray[np.float32]) -> NDArray[np.float32]:
            return values[below] + share * (values[below + 1] - values[below])

        strategy_columns = None if part.strategy_columns is None else read(part.strategy_columns)
        return replace(part, inputs=read(part.inputs), targets=read(part.targets), strategy_columns=strategy_columns)


def input_deviation(series: list[Series]) -> NDArray[np.float32]:
    """Return the standard deviation of each input over all segments, ``(input,)``, SI units."""
    count = sum(part.samples for part in series)
    mean = sum(part.inputs.sum(axis=0, dtype=np.float64) for part in series) / count
    squares = sum(
        part.inputs.var(axis=0, dtype=np.float64) * part.samples
        + part.samples * (part.inputs.mean(axis=0, dtype=np.float64) - mean) ** 2
        for part in series
    )
    return np.asarray(np.sqrt(squares / count), dtype=np.float32)
