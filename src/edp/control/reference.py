"""Reference of a control loop: strokes and tip poses over time, checked against the machine before the start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import AXES, TipGeometry
from edp.errors import ConfigError

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TipReference:
    """Strokes and tip over time; row t is the instant at which the levers of tick t are applied.

    Attributes:
        rate_hz: sampling rate in Hz.
        strokes: cylinder strokes, m, shape (ticks, 3).
        tip: tip x, y (m) and attitude (rad), shape (ticks, 3), at these strokes.
        judged: mask of the samples that a score counts, shape (ticks,); a lead-in does not count.
    """

    rate_hz: float
    strokes: Array
    tip: Array
    judged: NDArray[np.bool_]

    @property
    def ticks(self) -> int:
        """Number of ticks."""
        return len(self.strokes)

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        return self.ticks / self.rate_hz

    def rows(self, start: int, count: int) -> NDArray[np.int64]:
        """Return the indices of `count` samples from `start`; beyond the ends the first or last sample is used."""
        return np.clip(np.arange(start, start + count), 0, self.ticks - 1)

    def speeds(self) -> Array:
        """Return the stroke velocities, m/s, shape (ticks, 3): central differences."""
        return np.asarray(np.gradient(self.strokes, 1.0 / self.rate_hz, axis=0))


def reference_of_tip(
    name: str,
    poses: Array,
    geometry: TipGeometry,
    rate_hz: float,
    judged: NDArray[np.bool_] | None = None,
    margin: float = 0.0,
) -> TipReference:
    """Create a reference from tip poses.

    Args:
        name: name of the task, for messages.
        poses: tip x, y (m) and attitude (rad), shape (ticks, 3).
        geometry: geometry of the machine.
        rate_hz: sampling rate in Hz.
        judged: mask of the samples that count, shape (ticks,); None for all.
        margin: fraction of the stroke at either end that must stay free.

    Raises:
        ConfigError: names the first pose that cannot be reached, and its time.
    """
    strokes, reachable = geometry.strokes(poses)
    if not reachable.all():
        tick = int(np.argmin(reachable))
        x, y, attitude = poses[tick]
        raise ConfigError(
            f"reference '{name}': the {geometry.machine.name} cannot reach x = {x:.3f} m, y = {y:.3f} m at an attitude "
            f"of {np.degrees(attitude):.1f} deg, asked for at t = {tick / rate_hz:.2f} s; choose a line nearer to the "
            "middle of its reach or another attitude"
        )
    return _check_strokes(
        name, TipReference(rate_hz, strokes, np.asarray(poses, float), _mask(judged, strokes)), geometry, margin
    )


def reference_of_strokes(
    name: str,
    strokes_m: Array,
    geometry: TipGeometry,
    rate_hz: float,
    judged: NDArray[np.bool_] | None = None,
    margin: float = 0.0,
) -> TipReference:
    """Create a reference from strokes (m), shape (ticks, 3); see `reference_of_tip`.

    Raises:
        ConfigError: names the first stroke outside the cylinder, and its time.
    """
    strokes = np.asarray(strokes_m, float)
    reference = TipReference(rate_hz, strokes, geometry.tip(strokes), _mask(judged, strokes))
    return _check_strokes(name, reference, geometry, margin)


def _mask(judged: NDArray[np.bool_] | None, strokes: Array) -> NDArray[np.bool_]:
    return np.ones(len(strokes), bool) if judged is None else judged


def _check_strokes(name: str, reference: TipReference, geometry: TipGeometry, margin: float) -> TipReference:
    """Return the reference; raises ConfigError if a stroke is within the margin of an end."""
    if reference.ticks < 2:
        raise ConfigError(f"reference '{name}' has {reference.ticks} ticks; at least 2 must hold")
    shares = reference.strokes / geometry.full_m
    # 1e-9: rounding at exactly the margin is no violation.
    beyond = np.maximum(margin - shares, shares - (1.0 - margin)) > 1e-9
    if beyond.any():
        tick, axis = divmod(int(np.argmax(beyond)), AXES)
        raise ConfigError(
            f"reference '{name}': the {('boom', 'arm', 'bucket')[axis]} cylinder of the {geometry.machine.name} would "
            f"be at {shares[tick, axis]:.1%} of its stroke at t = {tick / reference.rate_hz:.2f} s; {margin:.0%} to "
            f"{1.0 - margin:.0%} must hold: choose a path farther from its ends"
        )
    return reference


def check_speeds(name: str, reference: TipReference, geometry: TipGeometry, fastest: Array) -> None:
    """Raise ConfigError if a reference requires a higher cylinder speed than possible.

    Args:
        name: name of the task, for messages.
        reference: reference to check.
        geometry: geometry of the machine.
        fastest: maximum speed of each cylinder, m/s, shape (2, 3): extending, then retracting.

    Raises:
        ConfigError: names the cylinder, the speed and the time.
    """
    speeds = reference.speeds()
    share = np.maximum(speeds / fastest[0], -speeds / fastest[1])
    if share.max() > 1.0:
        tick, axis = divmod(int(np.argmax(share)), AXES)
        raise ConfigError(
            f"reference '{name}': the {('boom', 'arm', 'bucket')[axis]} cylinder of the {geometry.machine.name} would "
            f"move at {speeds[tick, axis]:.3f} m/s at t = {tick / reference.rate_hz:.2f} s, {share.max():.2f} times as "
            "fast as it can; choose a lower speed"
        )
