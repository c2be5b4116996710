"""Policy as a controller, so that `run_loop` evaluates it like any other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.control.base import ControlFault, Controller, PlantInterface
from edp.control.geometry import AXES
from edp.control.learning.features import ReferenceRows, TaskFeatures, remembered
from edp.control.learning.spec import LearningSpec
from edp.control.limits import LoopLimits
from edp.control.models import ControlModels
from edp.control.reference import TipReference
from edp.errors import ConfigError
from edp.wording import typed

Array = NDArray[np.float64]
Policy = Callable[[NDArray[np.float32]], Any]
"""Function that maps an observation of `TaskEnvironment` to an action, shape (3,)."""


class PolicyController(Controller):
    """Levers of a policy that was learned in a `TaskEnvironment`: the same observation, the same limits.

    Args:
        policy: learned policy, evaluated every `hold` samples.
        spec: settings of the training environment; its plant and reward are not read.
        plant: plant to control now.
        limits: limits of the levers.
        models: models with the valve map of the plant, if the spec has a base controller.

    Raises:
        ConfigError: the plant does not measure what the policy reads, has another rate, or the map is missing.
    """

    def __init__(
        self, policy: Policy, spec: LearningSpec, plant: PlantInterface, limits: LoopLimits, models: ControlModels
    ) -> None:
        check_rate(spec, plant)
        self._policy, self._features = policy, TaskFeatures(spec, plant)
        self._hold, self._authority = spec.hold, spec.authority
        controller = spec.controller
        self._inner = None if controller is None else controller.build(plant, limits, models)
        inner_reads = () if self._inner is None else self._inner.reads
        super().__init__(plant, limits, tuple(dict.fromkeys((*self._features.reads, *inner_reads))))
        # Channels of the features come first among those that are read.
        self._width = len(self._features.reads)
        self._past = np.zeros((1, self._features.depth, AXES))
        self._action = np.zeros(AXES)
        self._rows: ReferenceRows | None = None
        self._last = self._noted = 0

    def begin(self, measured: Array, reference: TipReference) -> None:
        """Lay the reference down, and forget past levers."""
        self._rows = ReferenceRows(1, reference.ticks, self._features.preview)
        self._rows.put(0, reference)
        self._last, self._noted = reference.ticks - 1, 0
        self._past, self._action = np.zeros((1, self._features.depth, AXES)), np.zeros(AXES)
        if self._inner is not None:
            self._inner.reset(self._whole(measured), reference)

    def levers(self, measured: Array, tick: int) -> Array:
        """Return the policy's action as levers, or as a correction of the base controller's levers.

        Raises:
            ControlFault: the policy failed, or answered something else than three numbers.
        """
        if self._rows is None:
            raise ControlFault("no loop has begun")
        self._remember(tick)
        base = np.zeros(AXES) if self._inner is None else self._inner.step(self._whole(measured), tick)
        if tick % self._hold == 0:
            row = min(tick, self._last)
            now = self._rows.now(np.array([row]))
            seen = self._features.values(measured[None, : self._width], now, self._past, base[None])[0]
            self._action = self._ask_policy(seen)
        if self._inner is None:
            return self._action
        return base + self._authority * self._action

    def _ask_policy(self, seen: NDArray[np.float32]) -> Array:
        try:
            action = np.asarray(self._policy(seen), dtype=float)
        except Exception as error:  # a policy is anybody's code; a loop must end in the safe command
            raise ControlFault(f"the policy failed: {error}") from error
        if action.shape != (AXES,) or not np.isfinite(action).all():
            raise ControlFault("the policy's action is not three finite numbers")
        return np.asarray(np.clip(action, -1.0, 1.0))

    def missed(self, tick: int) -> None:
        """Store the levers that were applied during a missed sample, on their way to neutral."""
        self.info = {}
        self._remember(tick)

    def _remember(self, tick: int) -> None:
        """Store the levers of the previous sample, once per sample; skip the first sample."""
        if tick > self._noted:
            self._past, self._noted = remembered(self._past, self.before[None]), tick

    def _whole(self, measured: Array) -> Array:
        """Return an observation in the order of the plant, NaN for unread channels."""
        values = np.full(len(self.plant.channels), np.nan)
        values[self._columns] = measured
        return values


def check_rate(spec: LearningSpec, plant: PlantInterface) -> None:
    """Refuse a plant at whose rate the policy was not learned.

    Raises:
        ConfigError: they differ.
    """
    if spec.rate_hz != plant.rate_hz:
        raise ConfigError(
            f"the policy was learned at {typed(spec.rate_hz)} Hz, {plant.source} has {typed(plant.rate_hz)} Hz; "
            "learn one at its "
            "rate"
        )
