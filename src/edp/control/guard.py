"""Guard of a control loop: channels not to be trusted, and requests to fall back.

A monitor is such a guard. A loop knows no more of it than `LoopGuard` says: any object with its two methods will do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from edp.control.plant import PlantInterface
from edp.errors import ConfigError, EdpError, closest

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GuardVerdict:
    """Result of a guard for one sample.

    Attributes:
        untrusted: names of measured channels whose values controllers must not read.
        fall_back: whether the model of the controller is not to be trusted, so that its fallback has to output.
        reason: reason for the log; one short sentence without a full stop.
    """

    untrusted: frozenset[str] = frozenset()
    fall_back: bool = False
    reason: str = ""

    def __str__(self) -> str:
        parts = [f"not trusted: {', '.join(sorted(self.untrusted))}"] if self.untrusted else []
        parts += ["fall back"] if self.fall_back else []
        return "; ".join(parts) + (f" ({self.reason})" if self.reason else "")


TRUSTED = GuardVerdict()
"""Verdict without an objection."""


class LoopGuard(Protocol):
    """Monitor of a control loop that decides at each sample which data the controller may use.

    A guard decides alone, hysteresis included: what it says holds for one tick. It sees a tick before the controller
    does, so that no value is acted on which it has just refused.
    """

    def reset(self, plant: PlantInterface) -> None:
        """Begin with a loop.

        Args:
            plant: names, units and rate of what `step` will get.

        Raises:
            ConfigError: it cannot guard this plant.
        """
        ...

    def step(self, observation: Array) -> GuardVerdict:
        """Return the verdict for this sample.

        Args:
            observation: SI values in the order of ``plant.channels``, pilot pressures of the tick before among them
                where the plant measures them; NaN where one is missing; read-only.
        """
        ...


def verdict_of(guard: LoopGuard, plant: PlantInterface, observation: Array) -> GuardVerdict:
    """Return the verdict of a sample. A guard that fails or names an unknown channel causes a fallback.

    Args:
        guard: guard to ask.
        plant: plant for which the guard was reset.
        observation: SI values in the order of the plant's channels.
    """
    shown = np.asarray(observation).view()
    shown.flags.writeable = False
    try:
        verdict = guard.step(shown)
        measured = {channel.name for channel in plant.channels}
        for name in sorted(verdict.untrusted - measured):
            raise ConfigError(f"it names '{name}', which {plant.source} does not measure{closest(name, measured)}")
    except (EdpError, ArithmeticError, np.linalg.LinAlgError) as error:
        return GuardVerdict(fall_back=True, reason=f"the guard failed: {error}")
    return verdict
