"""Force base: the measured velocity changed by the cylinder force over a constant mass (eq. 3.8)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from edp.data.task import Task
from edp.networks.physics.base import PHYSICS, SPEEDS, PhysicsBase
from edp.networks.physics.dynamic import Dynamic, DynamicSpec
from edp.networks.physics.geometry import AXES, Pose, inverse

BLOCK = 65_536
"""Number of samples per block when averages are computed."""


@PHYSICS.register("force")
@dataclass(frozen=True, kw_only=True)
class ForceSpec(DynamicSpec):
    """`z = v + F k dt / M` with the time-averaged equivalent mass (eq. 3.8)."""

    def channels(self) -> tuple[str, ...]:
        return (*super().channels(), *SPEEDS)

    def build(self, task: Task) -> PhysicsBase:
        return Force(self, task)


class Force(Dynamic):
    """See `ForceSpec`; the pose serves the load, and the average of M_ii / J_i^2 over the training data."""

    mass: Tensor

    def __init__(self, spec: ForceSpec, task: Task) -> None:
        super().__init__(spec, task)
        # Ones until `read` or a bundle fills them: a division by zeros would give NaN in a blank network.
        self.register_buffer("mass", torch.ones(AXES))

    def read(self) -> None:
        super().read()
        with torch.no_grad():
            self.mass.copy_(self.geometry.mean_mass())

    def settle(self, parts: Iterable[Tensor]) -> None:
        """Average the equivalent masses over training inputs; the initial values are averages over all strokes."""
        with torch.no_grad():
            # Double precision: sums over hours of ticks lose digits in float32.
            total, ticks = torch.zeros(AXES, dtype=torch.float64), 0
            for part in parts:
                ticks += len(part)
                for block in part.split(BLOCK):
                    total += self.geometry.equivalent_mass(self.pose(block)).sum(dim=0, dtype=torch.float64)
            self.mass.copy_(total / ticks)

    def start(self, x: Tensor, pose: Pose, rate: Tensor, speed: Tensor) -> tuple[Tensor, Tensor]:
        measured = self.take(x, SPEEDS)
        return measured, self.net_torque(x, pose, rate, measured) * inverse(pose.lever) / self.mass

    def arithmetic(self) -> int:
        return self.torque_arithmetic() + 4 * AXES + AXES * len(self.task.horizons)
