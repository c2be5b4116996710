"""Kinematic base: the present cylinder velocity from joint rates (eq. 3.7)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from edp.data.task import Task
from edp.networks.physics.base import PHYSICS, PhysicsBase, PhysicsSpec
from edp.networks.physics.geometry import Pose


@PHYSICS.register("kinematic")
@dataclass(frozen=True, kw_only=True)
class KinematicSpec(PhysicsSpec):
    """Kinematic base `z = J(q) q'` for every horizon (eq. 3.7): the present joint velocity persists."""

    def build(self, task: Task) -> PhysicsBase:
        return Kinematic(self, task)


class Kinematic(PhysicsBase):
    """See `KinematicSpec`; from strokes, J q' is their difference per second."""

    def ahead(self, x: Tensor, pose: Pose, rate: Tensor, speed: Tensor) -> Tensor:
        return speed.unsqueeze(-2).expand(*speed.shape[:-1], len(self.task.horizons), speed.shape[-1])

    def arithmetic(self) -> int:
        return 0
