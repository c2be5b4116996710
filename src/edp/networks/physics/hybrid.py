"""Hybrid base: the velocity of the joints changed by the cylinder force over the mass of the pose (eq. 3.9)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from edp.data.task import Task
from edp.errors import ConfigError
from edp.networks.physics.base import PHYSICS, PhysicsBase
from edp.networks.physics.dynamic import Dynamic, DynamicSpec
from edp.networks.physics.geometry import AXES, Pose

HELD = 1e3
"""Factor by which the inertia of an axis is increased while dry friction holds the axis at standstill."""


@PHYSICS.register("hybrid")
@dataclass(frozen=True, kw_only=True)
class HybridPhysicsSpec(DynamicSpec):
    """`z = J(q) q' + F k dt / M(q)` with the mass of the present pose (eq. 3.9).

    Attributes:
        coupled: whether to solve the complete coupled equation of motion instead of dividing each force by its own M_ii
            / J_i^2 (the thesis); requires ``load = "all"``.

    Raises:
        ConfigError: coupled without the whole load.
    """

    space: ClassVar[dict[str, object]] = {**DynamicSpec.space, "coupled": (False, True)}
    coupled: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.coupled and self.load != "all":
            raise ConfigError(
                f"physics: coupled = true with load = '{self.load}' would pass the load on to other axes; "
                "load = 'all' must hold, or coupled = false"
            )

    def build(self, task: Task) -> PhysicsBase:
        return HybridPhysics(self, task)


class HybridPhysics(Dynamic):
    """See `HybridPhysicsSpec`."""

    spec: HybridPhysicsSpec

    def start(self, x: Tensor, pose: Pose, rate: Tensor, speed: Tensor) -> tuple[Tensor, Tensor]:
        own, coupling = self.geometry.masses(self.geometry.couplings(pose)[0])
        if not self.spec.coupled:
            return speed, self.net_torque(x, pose, rate, speed) * pose.lever / own
        torque = self.torque(x, pose, rate)
        # An axis that stands is held by its friction or stop, which takes what others ask of it: its inertia grows.
        most = self.geometry.axis("STATIC") * pose.lever.abs()  # the most that static friction takes
        stands = self.standing(speed) * (torque.abs() < most)
        own = own * (1.0 + HELD * torch.maximum(stands, self.stopped(pose, torque)))
        turned = solve(own, coupling, torque - self.sliding(pose, speed))
        return speed, pose.lever * turned + self.geometry.lever_change(pose) * rate.square()

    def arithmetic(self) -> int:
        coupled = 142 if self.spec.coupled else 0
        return self.torque_arithmetic() + 30 + coupled + AXES * len(self.task.horizons)


def solve(own: Tensor, coupling: Tensor, torque: Tensor) -> Tensor:
    """Return solution of the symmetric 3 x 3 system with diagonal `own` and off-diagonal 12, 13, 23, ``(..., 3)``."""
    (a, b, c), (d, e, f), (x, y, z) = own.unbind(-1), coupling.unbind(-1), torque.unbind(-1)
    # L D L' by hand: the matrix is positive definite.
    l21, l31 = d / a, e / a
    d2 = b - l21 * d
    l32 = (f - l31 * d) / d2
    # Pivots stay positive for a positive definite matrix, so that no pivoting and no branch is needed.
    d3 = c - l31 * e - l32 * l32 * d2
    y = y - l21 * x
    z = z - l31 * x - l32 * y
    third = z / d3
    second = y / d2 - l32 * third
    first = x / a - l21 * second - l31 * third
    return torch.stack((first, second, third), dim=-1)
