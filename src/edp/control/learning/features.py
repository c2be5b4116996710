"""Policy observations: measured channels, errors, future reference and levers, scaled to about one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import AXES
from edp.control.learning.spec import LearningSpec
from edp.control.plant import STROKES, PlantInterface
from edp.control.reference import TipReference
from edp.signals import KINDS, Channel, Kind

Array = NDArray[np.float64]
SCALES = {Kind.VELOCITY: 0.1, Kind.PRESSURE: 10e6}
"""Scale of a feature by kind of channel, SI units: typical grading speed and pressure. Other kinds use their largest
plausible value.
"""
STROKE_M, TIP_M, ATTITUDE_RAD, SPEED_M_S = 0.02, 0.05, 0.05, 0.2
"""Scales of errors and reference speeds. The errors of a good control loop are a tenth of these."""
MOST = 10.0
"""Limit of the absolute value of a scaled feature."""


@dataclass(frozen=True, eq=False)
class ReferenceNow:
    """Reference data for a policy at one sample, one row per environment.

    Attributes:
        strokes: now, m, shape (environment, 3).
        tip: now: x, y (m), attitude (rad), shape (environment, 3).
        ahead: stroke velocities now and later, m/s, shape (environment, previews, 3).
    """

    strokes: Array
    tip: Array
    ahead: Array


class TaskFeatures:
    """Builds observations; the same for an environment and for a controller.

    Args:
        spec: settings of the task.
        plant: interface of the plant for controllers.

    Attributes:
        names: names of the values, in order.
        reads: channels that are read.
        preview: ticks ahead of which the reference is shown.
        depth: number of past levers to store.

    Raises:
        ConfigError: the plant does not measure one of the channels.
    """

    def __init__(self, spec: LearningSpec, plant: PlantInterface) -> None:
        self.reads = tuple(dict.fromkeys((*spec.observed, *STROKES)))
        channels = [plant.channels[column] for column in plant.columns(self.reads)]
        self._geometry = plant.geometry
        self._shown = np.array([self.reads.index(name) for name in spec.observed], dtype=np.int64)
        self._strokes = np.array([self.reads.index(name) for name in STROKES])
        pairs = [self._scale(channel) for channel in channels]
        self._offset, self._width = np.array(pairs).T
        self.preview = np.array([round(ahead * spec.rate_hz) for ahead in spec.preview_s], dtype=np.int64)
        # Now is row 0: the levers of the last tick.
        self._past = np.array([0, *(round(ago * spec.rate_hz) for ago in spec.past_s)], dtype=np.int64)
        self.depth = int(self._past.max()) + 1
        axes = ("boom", "arm", "bucket")
        names = [*spec.observed, *(f"error of {name}" for name in (*STROKES, "TipX", "TipY", "TipAngle"))]
        names += [f"reference speed of {axis} in {ticks} ticks" for ticks in self.preview for axis in axes]
        names += [f"{axis} lever {ticks + 1} ticks ago" for ticks in self._past for axis in axes]
        self._with_base = bool(spec.base)
        self.names = (*names, *(f"{axis} lever of {spec.base}" for axis in axes if spec.base))

    def _scale(self, channel: Channel) -> tuple[float, float]:
        """Return the offset and width by which a channel becomes about one."""
        if channel.name in STROKES:
            half = 0.5 * float(self._geometry.full_m[STROKES.index(channel.name)])
            return half, half
        return 0.0, SCALES.get(channel.kind, float(np.abs(KINDS[channel.kind].plausible).max()))

    def values(self, measured: Array, now: ReferenceNow, levers: Array, base: Array) -> NDArray[np.float32]:
        """Return the observation of each environment, shape (environment, value).

        Args:
            measured: channels of `reads`, SI units, shape (environment, channel).
            now: the reference.
            levers: past levers, the latest first, shape (environment, depth, 3).
            base: levers of the base controller for this sample, shape (environment, 3); not read without a base
                controller.
        """
        lanes = len(measured)
        strokes = measured[:, self._strokes]
        tip = now.tip - self._geometry.tip(strokes)
        parts = [
            ((measured - self._offset) / self._width)[:, self._shown],
            (now.strokes - strokes) / STROKE_M,
            tip[:, :2] / TIP_M,
            # The difference of two angles, whatever turn they are counted in.
            np.arctan2(np.sin(tip[:, 2:]), np.cos(tip[:, 2:])) / ATTITUDE_RAD,
            now.ahead.reshape(lanes, -1) / SPEED_M_S,
            levers[:, self._past].reshape(lanes, -1),
        ]
        if self._with_base:
            parts.append(base)
        return np.asarray(np.clip(np.concatenate(parts, axis=1), -MOST, MOST), np.float32)


class ReferenceRows:
    """References of a batch as arrays, so that one look-up serves all environments.

    Args:
        lanes: number of environments.
        ticks: most ticks of an episode.
        preview: ticks ahead that are looked up.
    """

    def __init__(self, lanes: int, ticks: int, preview: NDArray[np.int64]) -> None:
        self._preview, self._lane = preview, np.arange(lanes)
        rows = ticks + int(preview.max(initial=0)) + 1
        self._strokes, self._tip, self._speeds = (np.zeros((lanes, rows, AXES)) for _ in range(3))
        self._judged = np.zeros((lanes, rows), dtype=np.bool_)

    def put(self, lane: int, reference: TipReference) -> None:
        """Set the reference of an environment; beyond its end it stays constant."""
        rows = reference.rows(0, self._strokes.shape[1])
        self._strokes[lane], self._tip[lane] = reference.strokes[rows], reference.tip[rows]
        self._speeds[lane], self._judged[lane] = reference.speeds()[rows], reference.judged[rows]

    def now(self, ticks: NDArray[np.int64]) -> ReferenceNow:
        """Return the rows of each environment at its sample, shape (environment,)."""
        ahead = self._speeds[self._lane[:, None], ticks[:, None] + self._preview]
        return ReferenceNow(self._strokes[self._lane, ticks], self._tip[self._lane, ticks], ahead)

    def tip(self, ticks: NDArray[np.int64]) -> Array:
        """Return the tip poses of each environment at its sample, shape (environment, 3)."""
        return np.asarray(self._tip[self._lane, ticks])

    def judged(self, ticks: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return whether each environment's sample is evaluated, shape (environment,)."""
        return self._judged[self._lane, ticks]


def remembered(levers: Array, applied: Array) -> Array:
    """Prepend levers, shape (environment, 3), to the past levers, shape (environment, depth, 3), latest first."""
    return np.concatenate([applied[:, None], levers[:, :-1]], axis=1)
